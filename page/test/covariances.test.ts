import assert from "node:assert/strict";
import { test } from "node:test";
import { angleDeviations, coordinateDeviations, lengthDeviations } from "../src/science/covariances.ts";
import { angles, coordinates, lengths } from "../src/science/measures.ts";
import { seeded } from "./helpers.ts";

const [FRAMES, KEYPOINTS, RANK] = [4, 5, 3];
const random = seeded(11);
const draw = (size: number, spread: number) => Float64Array.from({ length: size }, () => spread * (2 * random() - 1));
const points = draw(3 * FRAMES * KEYPOINTS, 1);
const modes = draw(3 * FRAMES * KEYPOINTS * RANK, 0.1);
const alone = draw(9 * FRAMES * KEYPOINTS, 0.2); // factors (3, 3) of what each point has for itself
const dense = Array.from({ length: FRAMES }, (_, frame) => denseOf(frame));
const covariances = { covariance: diagonalBlocks(), modes, rank: RANK };

/** Returns the covariance (3P, 3P) of all points of a frame. */
function denseOf(frame: number): number[][] {
  const size = 3 * KEYPOINTS;
  return Array.from({ length: size }, (_, row) =>
    Array.from({ length: size }, (_, column) => {
      let sum = 0;
      for (let mode = 0; mode < RANK; mode++) {
        sum += modes[(frame * size + row) * RANK + mode]! * modes[(frame * size + column) * RANK + mode]!;
      }
      if (Math.floor(row / 3) === Math.floor(column / 3)) {
        for (let k = 0; k < 3; k++) {
          sum += alone[3 * (frame * size + row) + k]! * alone[3 * (frame * size + column) + k]!;
        }
      }
      return sum;
    }),
  );
}

function diagonalBlocks(): Float64Array {
  const rows: number[] = [];
  for (const sigma of dense) {
    for (let at = 0; at < 3 * KEYPOINTS; at += 3) {
      const [x, y, z] = [sigma[at]!, sigma[at + 1]!, sigma[at + 2]!];
      rows.push(x[at]!, x[at + 1]!, x[at + 2]!, y[at + 1]!, y[at + 2]!, z[at + 2]!);
    }
  }
  return Float64Array.from(rows);
}

/** Returns sqrt(g' Sigma g) of each frame, with derivatives g by central differences. */
function bySteps(measure: (moved: Float64Array) => Float64Array): Float64Array {
  const [step, size] = [1e-6, 3 * KEYPOINTS];
  const gradients = Array.from({ length: size }, (_, at) => {
    const moved = (by: number) => points.map((value, index) => (index % size === at ? value + by : value));
    const [on, back] = [measure(moved(step)), measure(moved(-step))];
    return on.map((value, frame) => (value - back[frame]!) / (2 * step));
  });
  return Float64Array.from(dense, (sigma, frame) => {
    let sum = 0;
    for (let row = 0; row < size; row++) {
      for (let column = 0; column < size; column++) {
        sum += gradients[row]![frame]! * sigma[row]![column]! * gradients[column]![frame]!;
      }
    }
    return Math.sqrt(sum);
  });
}

function near(found: Float64Array, expected: Float64Array): void {
  assert.equal(found.length, FRAMES);
  expected.forEach((value, frame) => assert.ok(Math.abs(found[frame]! / value - 1) < 1e-5, `${found[frame]} ${value}`));
}

test("deviations of coordinates, lengths and angles are those of the whole covariance", () => {
  for (const axis of [0, 1, 2]) {
    const expected = bySteps((moved) => coordinates(moved, KEYPOINTS, 2, axis));
    near(coordinateDeviations(covariances, KEYPOINTS, 2, axis), expected);
  }
  for (const [a, b] of [
    [0, 3],
    [4, 1],
  ] as const) {
    const expected = bySteps((moved) => lengths(moved, KEYPOINTS, a, b));
    near(lengthDeviations(points, covariances, KEYPOINTS, a, b), expected);
  }
  for (const [a, b, c] of [
    [0, 3, 1],
    [2, 0, 4],
  ] as const) {
    const expected = bySteps((moved) => angles(moved, KEYPOINTS, a, b, c));
    near(angleDeviations(points, covariances, KEYPOINTS, a, b, c), expected);
  }
});

test("an unsure size leaves angles alone, and lengths as unsure as it is", () => {
  // One mode, in which every point goes away from the origin by 3 % of its distance.
  const frame = Float64Array.of(0, 0, 0, 2, 0, 0, 2, 5, 0);
  const mode = frame.map((value) => 0.03 * value);
  const covariance = Float64Array.from({ length: 18 }, (_, at) => {
    const point = [...mode.subarray(3 * Math.floor(at / 6), 3 * Math.floor(at / 6) + 3)];
    const [row, column] = [
      [0, 0],
      [0, 1],
      [0, 2],
      [1, 1],
      [1, 2],
      [2, 2],
    ][at % 6]!;
    return point[row!]! * point[column!]!;
  });
  const size = { covariance, modes: mode, rank: 1 };
  assert.ok(Math.abs(lengthDeviations(frame, size, 3, 0, 1)[0]! - 0.06) < 1e-9);
  assert.ok(Math.abs(lengthDeviations(frame, size, 3, 1, 2)[0]! - 0.15) < 1e-9);
  assert.ok(angleDeviations(frame, size, 3, 0, 1, 2)[0]! < 1e-6);
});

test("a right angle is off by what its ends are off across their edges", () => {
  const frame = Float64Array.of(2, 0, 0, 0, 0, 0, 0, 4, 0); // a, b, c
  const only = (keypoint: number) => ({
    covariance: Float64Array.from({ length: 18 }, (_, at) => (at === 6 * keypoint + 3 ? 0.01 : 0)), // 0.1 along y
    modes: new Float64Array(),
    rank: 0,
  });
  const degrees = 180 / Math.PI;
  assert.ok(Math.abs(angleDeviations(frame, only(0), 3, 0, 1, 2)[0]! - 0.05 * degrees) < 1e-9);
  assert.ok(angleDeviations(frame, only(2), 3, 0, 1, 2)[0]! < 1e-9);
});

test("where a point or its covariance is not known, no deviation is", () => {
  const unknown = { ...covariances, covariance: covariances.covariance.map((value, at) => (at === 0 ? NaN : value)) };
  const found = lengthDeviations(points, unknown, KEYPOINTS, 0, 1);
  assert.deepEqual([...found].map(Number.isNaN), [true, false, false, false]);
  const gone = points.map((value, at) => (at < 3 ? NaN : value));
  assert.deepEqual([...angleDeviations(gone, covariances, KEYPOINTS, 1, 0, 2)].map(Number.isNaN), [
    ...[true, false, false, false],
  ]);
});
