// Has node read .tsx as esbuild writes the page from it, with a document to draw into: `node --import` names this file.
import { GlobalRegistrator } from "@happy-dom/global-registrator";
import { readFileSync } from "node:fs";
import { registerHooks } from "node:module";
import { fileURLToPath } from "node:url";
import { transformSync } from "esbuild";

const OPTIONS = { loader: "tsx", format: "esm", target: "es2022", jsx: "automatic", jsxImportSource: "preact" };

registerHooks({
  load(url, context, next) {
    if (url.endsWith(".css")) return { format: "module", source: "", shortCircuit: true };
    if (!url.endsWith(".tsx")) return next(url, context);
    const source = transformSync(readFileSync(fileURLToPath(url), "utf8"), { ...OPTIONS, sourcefile: url }).code;
    return { format: "module", source, shortCircuit: true };
  },
});

GlobalRegistrator.register({ url: "http://127.0.0.1:8000/" });
