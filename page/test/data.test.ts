/** Files of the libraries that define their formats, and pixels of another implementation: a folder
 * with both is named by FEWVIEW_CASES. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { test } from "node:test";
import { frameMessage, readAnswer, readWatched, viewsIn } from "../src/live/messages.ts";
import { partsOf } from "../src/datasets/parts.ts";
import { openCapture } from "../src/data/capture.ts";
import { readCovariances } from "../src/data/covariances.ts";
import type { Frame } from "../src/data/placing.ts";
import { readSafetensors } from "../src/data/safetensors.ts";
import { ALL, emptyTake, nearest, putDetected, putStructures, STRUCTURE } from "../src/data/take.ts";
import { floats } from "../src/data/tensor.ts";
import { frameErrors, keypointErrors, LEFT_OUT, UNSEEN } from "../src/science/errors.ts";
import { angles, coordinates, lengths, speeds } from "../src/science/measures.ts";
import { project } from "../src/science/projection.ts";

const folder = process.env.FEWVIEW_CASES;
const skip = folder === undefined ? "FEWVIEW_CASES names no folder" : false;
const bytes = (name: string): ArrayBuffer => new Uint8Array(readFileSync(join(folder ?? "", name))).buffer;
const json = (name: string) => JSON.parse(readFileSync(join(folder ?? "", name), "utf8"));
const opened = () => {
  const file = bytes("capture.npz");
  return openCapture(async (start, end) => file.slice(start, end), file.byteLength);
};
const reconstruction = () => readSafetensors(bytes("reconstruction.safetensors"));
const take = async (frame: Frame) => {
  const { capture, detected } = await opened();
  const empty = emptyTake(capture, capture.frames, frame);
  putStructures(empty, reconstruction(), 0, 1);
  putDetected(empty, await detected(0, capture.frames), 0);
  return empty;
};

test("a capture is read as NumPy wrote it", { skip }, async () => {
  const { capture, detected, truth } = await opened();
  const expected = json("capture.json");
  assert.deepEqual([capture.frames, capture.views, capture.keypoints], expected.shape);
  const pixels = nulls(await detected(0, capture.frames));
  assert.deepEqual(pixels, expected.keypoints);
  const size = pixels.length / capture.frames;
  assert.deepEqual(nulls(await detected(2, 5)), pixels.slice(2 * size, 5 * size));
  assert.equal(capture.hasTruth, false);
  await assert.rejects(truth(), /no ground truth/);
  assert.deepEqual(capture.names, expected.keypoint_names);
  assert.deepEqual(capture.viewNames, expected.view_names);
  assert.deepEqual(capture.edges, expected.edges);
  assert.deepEqual(capture.imageSizes, expected.image_sizes);
  assert.equal(capture.fps, expected.fps);
  assert.deepEqual([...(capture.times ?? [])], expected.times);
});

for (const frame of ["level", "camera", "view"] as const) {
  test(`however the frames are placed (${frame}), points keep their pixels`, { skip }, async () => {
    const { points, cameras, frames, views, keypoints } = await take(frame);
    const expected = json("pixels.json") as (number | null)[];
    const pixels = new Float32Array(2 * keypoints);
    for (let camera = 0; camera < frames * views; camera++) {
      project(cameras, camera, points, Math.floor(camera / views) * keypoints, keypoints, pixels);
      pixels.forEach((value, at) => {
        const wanted = expected[camera * 2 * keypoints + at];
        assert.ok(wanted !== undefined);
        if (wanted === null) assert.ok(Number.isNaN(value), `camera ${camera}`);
        else assert.ok(Math.abs(value - wanted) < 0.02 + 1e-4 * Math.abs(wanted), `${camera}: ${value}, ${wanted}`);
      });
    }
  });
}

test("covariances are turned as points are", { skip }, async () => {
  for (const frame of ["level", "camera", "view"] as const) {
    const shown = await take(frame);
    const { keypoints } = shown;
    const file = reconstruction();
    // Each point is off along the way to it from the first of its frame.
    const ways = (points: ArrayLike<number>) =>
      Float32Array.from(points, (value, at) => value - points[at - (at % (3 * keypoints)) + (at % 3)]!);
    const squares = (way: Float32Array) =>
      Float32Array.from({ length: 2 * way.length }, (_, at) => {
        const [row, column] = [
          [0, 0],
          [0, 1],
          [0, 2],
          [1, 1],
          [1, 2],
          [2, 2],
        ][at % 6]!;
        const first = 3 * Math.floor(at / 6);
        return way[first + row!]! * way[first + column!]!;
      });
    const before = ways(floats(file, "points3d")!);
    file.set("points3d_modes", { shape: [shown.frames, keypoints, 3, 1], data: before });
    file.set("points3d_covariance", { shape: [shown.frames, keypoints, 6], data: squares(before) });
    const found = readCovariances(shown, file)!;
    assert.equal(found.rank, 1);
    const after = ways([...shown.points]);
    const near = (values: ArrayLike<number>, expected: Float32Array) =>
      expected.forEach((value, at) => assert.ok(Number.isNaN(value) || Math.abs(values[at]! - value) < 1e-3, frame));
    near(found.modes, after);
    near(found.covariance, squares(after));
  }
});

test("errors of keypoints are distances from those pixels, outliers left out", { skip }, async () => {
  const shown = await take("level");
  const { errors, add, next } = keypointErrors(shown);
  add(2, shown.frames);
  add(0, 2);
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

test("a take whose frames come in parts is that which came whole", { skip }, async () => {
  const whole = await take("view");
  const { capture, detected } = await opened();
  const parts = emptyTake(capture, capture.frames, "view");
  const some = (first: number, step: number) =>
    new Map(
      [...reconstruction()].map(([name, { shape, data }]) => {
        const size = data.length / shape[0]!;
        const kept = [...data].filter(
          (_, at) => Math.floor(at / size) >= first && (Math.floor(at / size) - first) % step === 0,
        );
        return [name, { shape: [kept.length / size, ...shape.slice(1)], data: Float32Array.from(kept) }];
      }),
    );
  putStructures(parts, some(0, 3), 0, 3);
  assert.deepEqual([...parts.there], [STRUCTURE, 0, 0, STRUCTURE, 0, 0]);
  assert.deepEqual([nearest(parts, 2), nearest(parts, 3), nearest(parts, 5)], [0, 3, 3]);
  putStructures(parts, some(0, 1), 0, 1);
  putDetected(parts, await detected(4, capture.frames), 4);
  assert.deepEqual([...parts.there.slice(3)], [STRUCTURE, ALL, ALL]);
  putDetected(parts, await detected(0, 4), 0);
  assert.deepEqual(parts, whole);
  assert.deepEqual(nulls(whole.deviations), nulls(floats(reconstruction(), "points3d_sd")!));
});

test("messages of a stream are those of the service", { skip }, () => {
  const expected = json("answer.json");
  const { sequence, lifted } = readAnswer(bytes("answer.bin"), expected.points3d.length / 3);
  assert.equal(sequence, 70_000);
  assert.ok(lifted !== null);
  const { points, cameras, outliers, errors, bits, views, deviations } = lifted;
  assert.deepEqual(nulls(deviations as Float32Array), expected.points3d_sd);
  assert.deepEqual([...(bits as number[])], [9]);
  assert.deepEqual(nulls(points), expected.points3d);
  assert.deepEqual(nulls(outliers as Float32Array), expected.outlier_probability);
  assert.deepEqual(nulls(errors), expected.reprojection_errors);
  assert.deepEqual([...cameras.models], expected.camera_models);
  for (const name of ["rotations", "translations", "scales", "focals", "distortions"] as const) {
    assert.deepEqual(nulls(cameras[name]), expected[name], name);
  }
  assert.deepEqual(nulls(cameras.principalPoints), expected.principal_points);
  const pixels = Float32Array.from(expected.sent as (number | null)[], (value) => value ?? NaN);
  const watched = bytes("watched.bin");
  assert.equal(viewsIn(watched), views);
  assert.deepEqual(readWatched(watched, expected.points3d.length / 3), { pixels, lifted });
  const without = readAnswer(bytes("answer-off.bin"), expected.points3d.length / 3).lifted;
  assert.deepEqual(without, { ...lifted, deviations: undefined });
  assert.deepEqual(new Uint8Array(frameMessage(3, views, pixels)), new Uint8Array(bytes("frame.bin")));
});

for (const name of ["capture.npz", "reconstruction.safetensors"]) {
  test(`${name} is cut into parts that are files of their own`, { skip }, async () => {
    const file = new File([bytes(name)], name);
    assert.equal(await partsOf(file), null); // it is short
    const parts = await partsOf(file, 700);
    if (name.startsWith("reconstruction")) return assert.equal(parts, null); // it has no keypoints
    const expected = json("capture.json");
    const [frames, views, keypoints] = expected.shape;
    assert.ok(parts !== null && parts.frames === frames && parts.size < frames);
    const found: (number | null)[] = [];
    const times: number[] = [];
    for (let first = 0; first < frames; first += parts.size) {
      const part = readSafetensors(await parts.part(first, Math.min(frames, first + parts.size)).arrayBuffer());
      assert.deepEqual(part.get("keypoints")?.shape.slice(1), [views, keypoints, 2]);
      found.push(...nulls(part.get("keypoints")?.data as Float32Array));
      times.push(...(part.get("times")?.data ?? []));
    }
    assert.deepEqual(found, expected.keypoints);
    assert.deepEqual(times, expected.times);
    const { skeleton = "", view_names = "", image_sizes = "", fps } = parts.description;
    const { keypoint_names, edges } = JSON.parse(skeleton);
    assert.deepEqual([keypoint_names, edges], [expected.keypoint_names, expected.edges]);
    assert.deepEqual([JSON.parse(view_names), JSON.parse(image_sizes)], [expected.view_names, expected.image_sizes]);
    assert.equal(Number(fps), expected.fps);
  });
}

function nulls(values: Float32Array): (number | null)[] {
  return Array.from(values, (value) => (Number.isNaN(value) ? null : value));
}

test("lengths, angles and speeds are those of NumPy", { skip }, async () => {
  const { points, keypoints, times } = await take("level");
  const expected = json("measures.json");
  const near = (found: ArrayLike<number>, truth: (number | null)[], what: string) => {
    assert.deepEqual(
      Array.from(found, (value) => Number.isNaN(value)),
      truth.map((value) => value === null),
      what,
    );
    truth.forEach((value, frame) => assert.ok(value === null || Math.abs(found[frame]! - value) < 1e-4 * value, what));
  };
  for (const [a, b, c] of [
    [0, 1, 2],
    [3, 5, 6],
  ] as const) {
    near(lengths(points, keypoints, a, b), expected[`length ${a} ${b}`], "length");
    near(angles(points, keypoints, a, b, c), expected[`angle ${a} ${b} ${c}`], "angle");
    near(speeds(points, keypoints, a, null), expected[`speed ${a} of frames`], "speed of frames");
    near(speeds(points, keypoints, a, times), expected[`speed ${a}`], "speed");
    const axes = [0, 1, 2].map((axis) => coordinates(points, keypoints, a, axis)[0]);
    assert.deepEqual(axes, [...points.subarray(3 * a, 3 * a + 3)]);
  }
});
