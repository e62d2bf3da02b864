import assert from "node:assert/strict";
import { test } from "node:test";
import { aligned, distances } from "../src/science/aligning.ts";
import { boxOf, roundLength, subjectSize, usualStep } from "../src/science/extent.ts";
import { frameFindings } from "../src/science/frame_findings.ts";
import { csvOf, cellOf } from "../src/parts/csv.ts";
import { afterClick } from "../src/result/selection.ts";
import { edgeAngles, namedAngles } from "../src/science/named_angles.ts";
import { sidesOf } from "../src/science/sides.ts";
import { quantile, worstFrames } from "../src/science/worst.ts";
import { seeded } from "./helpers.ts";

test("a name is of a side only if its mirror image is a name, too", () => {
  const pairs: [string, string][] = [
    ["left_wrist", "right_wrist"],
    ["LeftWrist", "RightWrist"],
    ["lwrist", "rwrist"],
    ["LWrist", "RWrist"],
    ["L_wrist", "R_wrist"],
    ["wrist_l", "wrist_r"],
    ["wrist.L", "wrist.R"],
    ["wristL", "wristR"],
    ["eye_l_inner", "eye_r_inner"],
    ["wrist_left", "wrist_right"],
    ["LEFT WRIST", "RIGHT WRIST"],
  ];
  for (const [left, right] of pairs) assert.deepEqual(sidesOf([left, "nose", right]), [-1, 0, 1], left);
  assert.deepEqual(sidesOf(["lowerback", "rump", "tail", "neck", "left_ear"]), [0, 0, 0, 0, 0]);
  assert.deepEqual(sidesOf(["lowerback", "rowerback"]), [-1, 1]);
});

test("the worst frames keep apart and come worst first", () => {
  const errors = [1, 9, 8, NaN, 3, 2, 7, 1];
  assert.deepEqual(worstFrames(errors, 3, 2), [1, 6, 4]);
  assert.deepEqual(worstFrames(errors, 1, 2), [1]);
  assert.deepEqual(worstFrames([NaN, NaN], 3, 1), []);
});

test("quantiles leave out what is not known", () => {
  assert.equal(quantile([3, NaN, 1, 2], 0.5), 2);
  assert.equal(quantile([3, NaN, 1, 2], 1), 3);
  assert.equal(quantile([NaN], 0.5), 0);
});

test("lengths are rounded to those that people count in", () => {
  const cases: [number, number][] = [
    [1.2, 1],
    [1.7, 2],
    [0.43, 0.5],
    [8, 10],
    [270, 200],
    [0.0031, 0.002],
  ];
  for (const [length, round] of cases) {
    assert.ok(Math.abs(roundLength(length) / round - 1) < 1e-9, `${length}`);
  }
});

test("sizes, boxes and steps are those of most frames", () => {
  // Two points a unit apart that go 0.1 along x a frame; one frame is missing, one far astray.
  const frames = 300;
  const points = new Float32Array(frames * 6);
  for (let frame = 0; frame < frames; frame++) points.set([0.1 * frame, 0, 0, 0.1 * frame, 1, 0], 6 * frame);
  points.fill(NaN, 60, 66);
  points.fill(1e6, 120, 126);
  assert.ok(Math.abs(subjectSize(points, 2) - 1) < 1e-5);
  assert.ok(Math.abs(usualStep(points, 2) - 0.1) < 1e-5);
  const { low, high } = boxOf(points, 2);
  assert.ok(low[0] >= 0 && low[0] < 1 && high[0] > 28 && high[0] <= 30);
  assert.deepEqual([low[1], high[1]], [0, 1]);
});

test("points that were turned, scaled and shifted are laid over each other again", () => {
  const random = seeded(7);
  for (let round = 0; round < 20; round++) {
    const to = Float32Array.from({ length: 3 * 12 }, () => random() - 0.5);
    const turn = unit([random() - 0.5, random() - 0.5, random() - 0.5, random() - 0.5]);
    const scale = 0.2 + 3 * random();
    const from = new Float32Array(to.length);
    for (let at = 0; at < to.length; at += 3) {
      const [a, b, c] = rotated(turn, [to[at]!, to[at + 1]!, to[at + 2]!]);
      from.set([scale * a + 5, scale * b - 2, scale * c + 1], at);
    }
    from[4] = NaN;
    from[3] = NaN;
    from[5] = NaN;
    for (const each of [false, true]) {
      const moved = aligned(from, to, 4, each);
      const off = distances(moved, to, 4);
      assert.equal(off.length, 3);
      assert.ok(Math.max(...off) < 2e-5, off.join());
      assert.ok(Number.isNaN(moved[3]));
    }
  }
});

test("a mirror image is not turned over", () => {
  const random = seeded(8);
  const to = Float32Array.from({ length: 3 * 10 }, () => random() - 0.5);
  const from = to.map((value, at) => (at % 3 === 2 ? -value : value));
  assert.ok(distances(aligned(from, to, 10, false), to, 10)[0]! > 0.05);
});

type Vector = [number, number, number];
type Quaternion = [number, number, number, number];

function unit([w, x, y, z]: Quaternion): Quaternion {
  const size = Math.hypot(w, x, y, z);
  return [w / size, x / size, y / size, z / size];
}

/** q v q*, written with cross products. */
function rotated([w, x, y, z]: Quaternion, v: Vector): Vector {
  const cross = (a: Vector, b: Vector): Vector => [
    a[1] * b[2] - a[2] * b[1],
    a[2] * b[0] - a[0] * b[2],
    a[0] * b[1] - a[1] * b[0],
  ];
  const t = cross([2 * x, 2 * y, 2 * z], v);
  const u = cross([x, y, z], t);
  return [v[0] + w * t[0] + u[0], v[1] + w * t[1] + u[1], v[2] + w * t[2] + u[2]];
}

test("bits of frames become findings with ranges", () => {
  const found = frameFindings([0, 2, 2, 0, 3, 8, 0, 2]);
  assert.deepEqual(
    found.map(({ code, frames }) => [code, frames]),
    [
      ["rig_not_used", [[4, 4]]],
      [
        "frame_unlike_fit",
        [
          [1, 2],
          [4, 4],
          [7, 7],
        ],
      ],
      ["not_in_room", [[5, 5]]],
    ],
  );
  assert.deepEqual(frameFindings([0, 0]), []);
});

test("joints have angles by the usual names of their keypoints", () => {
  const parts = ["shoulder", "elbow", "wrist", "hip", "knee", "ankle"];
  const both = (name: (side: string, part: string) => string) =>
    ["l", "r"].flatMap((side) => parts.map((part) => name(side, part)));
  const word = (side: string) => (side === "l" ? "left" : "right");
  const capital = (text: string) => text.slice(0, 1).toUpperCase() + text.slice(1);
  const namings: [string, string[]][] = [
    ["COCO", both((side, part) => `${word(side)}_${part}`)],
    ["BODY-25", both((side, part) => `${side.toUpperCase()}${capital(part)}`)],
    ["Human3.6M", both((side, part) => `${capital(word(side))}${capital(part === "ankle" ? "foot" : part)}`)],
    ["of a side last", both((side, part) => `${part}_${side}`)],
    ["of small letters", both((side, part) => side + part)],
  ];
  const expected = [
    ["knee", [3, 4, 5]],
    ["hip", [0, 3, 4]],
    ["elbow", [0, 1, 2]],
    ["shoulder", [3, 0, 1]],
  ];
  for (const [naming, names] of namings) {
    const found = namedAngles(names, sidesOf(names));
    const mirrored = (triple: unknown) => (triple as number[]).map((keypoint) => keypoint + parts.length);
    assert.deepEqual(
      found,
      expected.map(([joint, left]) => ({ joint, left, right: mirrored(left) })),
      naming,
    );
  }
  const toes = ["LKnee", "LAnkle", "LBigToe", "RKnee", "RAnkle", "RBigToe"];
  assert.deepEqual(namedAngles(toes, sidesOf(toes)), [{ joint: "ankle", left: [0, 1, 2], right: [3, 4, 5] }]);
  assert.deepEqual(namedAngles(["knee", "hip", "ankle"], [0, 0, 0]), []);
});

test("two edges that meet alone have an angle", () => {
  const edges = [
    [4, 2],
    [0, 2],
    [4, 5],
    [4, 6],
  ] as const; // at 4 three meet
  assert.deepEqual(edgeAngles(edges), [[4, 2, 0]]);
  assert.deepEqual(edgeAngles([]), []);
});

test("a click selects one, with Shift up to three", () => {
  assert.deepEqual(afterClick([], 4, false), [4]);
  assert.deepEqual(afterClick([4], 4, false), []);
  assert.deepEqual(afterClick([4, 5], 4, false), [4]);
  assert.deepEqual(afterClick([4, 5], 4, true), [5]);
  assert.deepEqual(afterClick([4, 5, 6], 7, true), [5, 6, 7]);
});

test("a table runs nothing in a spreadsheet, and has no cell where there is no number", () => {
  const columns = [
    { name: "=HYPERLINK(1)", values: [1, NaN] },
    { name: 'knee, "left"', values: [0.1 + 0.2, -2] },
  ];
  assert.equal(csvOf(columns), `'=HYPERLINK(1),"knee, ""left"""\r\n1,0.3\r\n,-2\r\n`);
  for (const start of "=+-@\t\r") assert.match(cellOf(`${start}1`), /^"?'/);
});
