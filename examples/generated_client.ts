// From keypoints to 3D with a client that openapi-typescript generated: docs/clients.md.
import { readFileSync, writeFileSync } from "node:fs";
import createClient from "openapi-fetch";
import type { components, paths } from "./fewview.js";

const [url, file, target] = process.argv.slice(2) as [string, string, string];
const client = createClient<paths>({ baseUrl: url });

function must<T>({ data, error }: { data?: T; error?: components["schemas"]["Problem"] }): T {
  if (data === undefined) throw new Error(`${error?.code}: ${error?.detail}`);
  return data;
}

// (frames, views, keypoints, 2) in pixels, null where not observed.
const keypoints: ([number, number] | null)[][][] = JSON.parse(readFileSync(file, "utf8"));
const dataset = must(await client.POST("/datasets", { body: { keypoints, name: "generated" } }));
let fit = must(
  await client.POST("/fits", { body: { dataset_id: dataset.id, config: { steps: 60, refine: "off" } } }),
);
while (fit.status === "queued" || fit.status === "running") {
  await new Promise((resolve) => setTimeout(resolve, 200));
  fit = must(await client.GET("/fits/{fit_id}", { params: { path: { fit_id: fit.id } } }));
}
if (!fit.model_id) throw new Error(fit.error?.message);

// An answer may be JSON or bytes: the types hold both, so a program says which it takes.
const body = { model: fit.model_id, frames: keypoints.slice(0, 1) };
const { frames } = must(await client.POST("/lift", { body })) as components["schemas"]["Lift"];
console.log(JSON.stringify(frames[0]?.points3d));

const path = { fit_id: fit.id };
const arrays = await client.GET("/fits/{fit_id}/reconstruction", {
  params: { path, query: { format: "npz" } },
  parseAs: "arrayBuffer",
});
writeFileSync(target, Buffer.from(must<unknown>(arrays) as ArrayBuffer));
