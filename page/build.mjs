// Writes what the service serves: index.html, and the files it names by a digest of their content.
import { createHash } from "node:crypto";
import { mkdir, readFile, rename, rm, writeFile } from "node:fs/promises";
import { basename, join } from "node:path";
import { build } from "esbuild";
import { BUNDLE } from "./bundle.mjs";

const output = process.argv[2];
const fresh = `${output}.new`;
const files = join(fresh, "page");

await rm(fresh, { recursive: true, force: true });
await mkdir(files, { recursive: true });
const { metafile } = await build({
  ...BUNDLE,
  outdir: files,
  minify: true,
  legalComments: "eof",
  entryNames: "[name]-[hash]",
  chunkNames: "[name]-[hash]",
  metafile: true,
});
const icon = await readFile("icon.svg");
const iconName = `icon-${createHash("sha256").update(icon).digest("hex").slice(0, 8)}.svg`;
await writeFile(join(files, iconName), icon);

const [script, entry] = Object.entries(metafile.outputs).find(([, each]) => each.entryPoint === "src/main.tsx");
const shared = entry.imports.filter(({ kind }) => kind === "import-statement");
const preloads = shared.map(({ path }) => `<link rel="modulepreload" href="page/${basename(path)}" />`);
const index = (await readFile("index.html", "utf8"))
  .replace("SCRIPT", basename(script))
  .replace("PRELOADS", preloads.join("\n    "))
  .replace("STYLE", basename(entry.cssBundle))
  .replace("ICON", iconName);
await writeFile(join(fresh, "index.html"), index);
await rm(output, { recursive: true, force: true });
await rename(fresh, output);
