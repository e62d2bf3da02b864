// Asks the search of a built site, as its pages do: `node search.mjs SITE < queries.json`.
// Prints for each query the places that are found, best first.

import fs from "node:fs";
import path from "node:path";
import vm from "node:vm";

const [site] = process.argv.slice(2);
const workers = path.join(site, "assets", "javascripts", "workers");
const file = fs.readdirSync(workers).find((name) => /^search\..*\.js$/.test(name));
const index = JSON.parse(fs.readFileSync(path.join(site, "search", "search_index.json"), "utf8"));

// What a worker of a browser has.
let listen;
let answer;
const worker = { console, setTimeout, importScripts() {}, postMessage: (message) => (answer = message) };
worker.addEventListener = (_kind, listener) => (listen = listener);
worker.self = worker;
vm.runInNewContext(fs.readFileSync(path.join(workers, file), "utf8"), worker);

const SETUP = 0;
const QUERY = 2;
const found = {};
await listen({ data: { type: SETUP, data: { ...index, options: { suggest: false } } } });
for (const query of JSON.parse(fs.readFileSync(0, "utf8"))) {
  await listen({ data: { type: QUERY, data: query } });
  found[query] = answer.data.items.flat().map((section) => section.location);
}
console.log(JSON.stringify(found));
