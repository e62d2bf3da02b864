import assert from "node:assert/strict";
import { test } from "node:test";
import { constantEdges } from "../src/science/constant_edges.ts";

// A trunk with two arms of two bones and two legs, and a stiff head of three points.
const BONES: [number, number, number][] = [
  [0, 1, 0.5], // from, to, length
  [1, 2, 0.3],
  [2, 3, 0.28],
  [1, 4, 0.3],
  [4, 5, 0.28],
  [0, 6, 0.45],
  [6, 7, 0.42],
  [0, 8, 0.45],
  [8, 9, 0.42],
  [1, 10, 0.2],
];
const HEAD = [
  [10, 11],
  [10, 12],
  [11, 12],
];
const KEYPOINTS = 13;

/** Returns numbers that look drawn, the same ones each time. */
function drawn(): () => number {
  let state = 7;
  return () => {
    state = (state * 1103515245 + 12345) % 2147483648;
    return state / 2147483648 - 0.5;
  };
}

function captured(frames: number, noise: number): Float32Array {
  const next = drawn();
  const points = new Float32Array(3 * frames * KEYPOINTS);
  for (let frame = 0; frame < frames; frame++) {
    const at = (keypoint: number) => 3 * (frame * KEYPOINTS + keypoint);
    const put = (from: number, to: number, offset: number[]) =>
      offset.forEach((value, axis) => (points[at(to) + axis] = points[at(from) + axis]! + value));
    for (const [from, to, length] of BONES) {
      const way = [next(), next(), next()];
      const size = Math.hypot(...way);
      put(
        from,
        to,
        way.map((value) => (length * value) / size),
      );
    }
    const turn = 6 * next();
    put(10, 11, [0.1 * Math.cos(turn), 0.1 * Math.sin(turn), 0]);
    put(10, 12, [0.1 * Math.cos(turn + 1), 0.1 * Math.sin(turn + 1), 0]);
    for (let value = at(0); value < at(KEYPOINTS); value++) points[value]! += noise * next();
  }
  return points;
}

const named = (edges: number[][]) => edges.map((edge) => edge.join("-")).sort();

test("the bones of a figure that moves are found, and its stiff head", () => {
  for (const noise of [0, 0.01]) {
    const found = constantEdges({ frames: 200, keypoints: KEYPOINTS, points: captured(200, noise) });
    const right = [...BONES.map(([from, to]) => [from, to]), ...HEAD];
    assert.deepEqual(named(found.map(({ edge }) => edge)), named(right), `noise ${noise}`);
  }
});

test("frames that are missing or wrong change nothing", () => {
  const points = captured(200, 0.005);
  const there = new Uint8Array(200).fill(2);
  for (let frame = 0; frame < 40; frame++) {
    points.fill(frame % 2 === 0 ? NaN : 1000 * frame, 3 * frame * KEYPOINTS + 6, 3 * frame * KEYPOINTS + 12);
    there[frame + 100] = 0;
  }
  const found = constantEdges({ frames: 200, keypoints: KEYPOINTS, points, there });
  assert.equal(found.length, BONES.length + HEAD.length);
});

test("a keypoint that no bone holds stands alone, and nothing is made of no frames", () => {
  const points = captured(100, 0);
  const next = drawn();
  for (let frame = 0; frame < 100; frame++) {
    for (let axis = 0; axis < 3; axis++) points[3 * (frame * KEYPOINTS + 7) + axis] = 20 * next();
  }
  const found = constantEdges({ frames: 100, keypoints: KEYPOINTS, points });
  assert.ok(found.every(({ edge }) => !edge.includes(7)));
  assert.deepEqual(constantEdges({ frames: 3, keypoints: KEYPOINTS, points: captured(3, 0) }), []);
});
