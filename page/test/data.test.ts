/** Files of the libraries that define their formats, and pixels of another implementation: a folder
 * with both is named by FEWVIEW_CASES. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { test } from "node:test";
import { readNpz } from "../src/data/npz.ts";
import { readSafetensors } from "../src/data/safetensors.ts";
import { captureOf, takeOf, type Frame } from "../src/data/take.ts";
import { frameErrors, keypointErrors, LEFT_OUT, UNSEEN } from "../src/science/errors.ts";
import { project } from "../src/science/projection.ts";

const folder = process.env.FEWVIEW_CASES;
const skip = folder === undefined ? "FEWVIEW_CASES names no folder" : false;
const bytes = (name: string): ArrayBuffer => new Uint8Array(readFileSync(join(folder ?? "", name))).buffer;
const json = (name: string) => JSON.parse(readFileSync(join(folder ?? "", name), "utf8"));
const take = (frame: Frame) =>
  takeOf(captureOf(readNpz(bytes("capture.npz"))), readSafetensors(bytes("reconstruction.safetensors")), frame);

test("a capture is read as NumPy wrote it", { skip }, () => {
  const capture = captureOf(readNpz(bytes("capture.npz")));
  const expected = json("capture.json");
  assert.deepEqual([capture.frames, capture.views, capture.keypoints], expected.shape);
  assert.deepEqual(nulls(capture.detected), expected.keypoints);
  assert.deepEqual(capture.names, expected.keypoint_names);
  assert.deepEqual(capture.viewNames, expected.view_names);
  assert.deepEqual(capture.edges, expected.edges);
  assert.deepEqual(capture.imageSizes, expected.image_sizes);
  assert.equal(capture.fps, expected.fps);
  assert.deepEqual([...(capture.times ?? [])], expected.times);
});

for (const frame of ["level", "camera", "view"] as const) {
  test(`however the frames are placed (${frame}), points keep their pixels`, { skip }, () => {
    const { points, cameras, frames, views, keypoints } = take(frame);
    const expected = json("pixels.json") as (number | null)[];
    const pixels = new Float32Array(2 * keypoints);
    for (let camera = 0; camera < frames * views; camera++) {
      project(cameras, camera, points, Math.floor(camera / views) * keypoints, keypoints, pixels);
      pixels.forEach((value, at) => {
        const wanted = expected[camera * 2 * keypoints + at];
        if (wanted === null) assert.ok(Number.isNaN(value), `camera ${camera}`);
        else assert.ok(Math.abs(value - wanted) < 0.02 + 1e-4 * Math.abs(wanted), `${camera}: ${value}, ${wanted}`);
      });
    }
  });
}

test("errors of keypoints are distances from those pixels, outliers left out", { skip }, () => {
  const shown = take("level");
  const { errors, next } = keypointErrors(shown);
  while (!next());
  const expected = json("errors.json");
  errors.worst.forEach((value, at) => {
    const wanted = { unseen: UNSEEN, "left out": LEFT_OUT }[expected.worst[at] as string] ?? expected.worst[at];
    assert.ok(Math.abs(value - wanted) < 0.02 + 1e-4 * Math.abs(wanted), `${at}: ${value}, ${wanted}`);
  });
  const means = nulls(frameErrors(shown));
  means.forEach((value, frame) => {
    const wanted = expected.means[frame];
    assert.ok(value === wanted || Math.abs(value! - wanted) < 1e-4, `${frame}: ${value}, ${wanted}`);
  });
});

function nulls(values: Float32Array): (number | null)[] {
  return Array.from(values, (value) => (Number.isNaN(value) ? null : value));
}
