// What neither compiler nor prettier sees: promises that nobody waits for, hooks that look at old values, `any`.
import hooks from "eslint-plugin-react-hooks";
import tseslint from "typescript-eslint";

// Loops over typed arrays, where an index is inside by how the loop is written: `!` costs nothing there.
const LOOPS = ["src/science/**", "src/data/**", "src/live/messages.ts", "src/result/**", "test/**"];

export default tseslint.config(
  { ignores: ["src/api/openapi.d.ts", "**/*.mjs"] },
  { linterOptions: { reportUnusedDisableDirectives: "error" } },
  ...tseslint.configs.recommendedTypeChecked,
  {
    languageOptions: { parserOptions: { projectService: true, tsconfigRootDir: import.meta.dirname } },
    plugins: { "react-hooks": hooks },
    rules: {
      "react-hooks/rules-of-hooks": "error",
      "react-hooks/exhaustive-deps": "error", // a dependency that is left out has its reason beside it
      "@typescript-eslint/no-non-null-assertion": "error",
      "@typescript-eslint/unbound-method": "off", // our objects are closures: no method has a `this`
      "@typescript-eslint/no-floating-promises": [
        "error",
        { allowForKnownSafeCalls: [{ from: "package", name: "test", package: "node:test" }] },
      ],
    },
  },
  { files: LOOPS, rules: { "@typescript-eslint/no-non-null-assertion": "off" } },
  {
    files: ["test/**"], // what Python wrote is JSON of no type
    rules: {
      "@typescript-eslint/no-unsafe-argument": "off",
      "@typescript-eslint/no-unsafe-assignment": "off",
      "@typescript-eslint/no-unsafe-member-access": "off",
      "@typescript-eslint/no-unsafe-return": "off",
      "@typescript-eslint/require-await": "off",
    },
  },
);
