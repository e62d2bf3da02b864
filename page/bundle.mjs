// How esbuild makes the page of its sources, for the service (build.mjs) and for who works on it (dev.mjs).
export const BUNDLE = {
  entryPoints: ["src/main.tsx"],
  bundle: true,
  splitting: true,
  format: "esm",
  target: "es2022",
  jsx: "automatic",
  jsxImportSource: "preact",
  alias: { react: "preact/compat" },
  logLevel: "warning",
};
