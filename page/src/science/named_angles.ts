/** The angles of joints that people ask for, by the usual names of keypoints: COCO, BODY-25, Halpe,
 * Human3.6M, MediaPipe. */

import type { Side } from "./sides.ts";

/** Keypoints a, b, c of an angle at b. */
export type Triple = [number, number, number];

export interface NamedAngle {
  joint: string;
  left: Triple | null;
  right: Triple | null;
}

/** What keypoints are called without their side, the best first. */
const PARTS = {
  shoulder: ["shoulder", "sho"],
  elbow: ["elbow", "elb"],
  wrist: ["wrist", "wri"],
  hip: ["hip"],
  knee: ["knee"],
  ankle: ["ankle", "foot"], // Human3.6M calls it the foot
  toe: ["bigtoe", "toe", "footindex", "toebase", "smalltoe"],
} as const;
type Part = keyof typeof PARTS;

const JOINTS: [Part, Part, Part][] = [
  ["hip", "knee", "ankle"],
  ["shoulder", "hip", "knee"],
  ["knee", "ankle", "toe"],
  ["shoulder", "elbow", "wrist"],
  ["hip", "shoulder", "elbow"],
];

/** Returns the angles whose three keypoints are there on the left or on the right. */
export function namedAngles(names: readonly string[], sides: readonly Side[]): NamedAngle[] {
  const find = (part: Part, side: Side): number | undefined => {
    for (const word of PARTS[part]) {
      const found = names.findIndex((name, keypoint) => sides[keypoint] === side && bareWords(name).includes(word));
      if (found >= 0) return found;
    }
    return undefined;
  };
  return JOINTS.flatMap((parts) => {
    const ofSide = (side: Side): Triple | null => {
      const [a, b, c] = parts.map((part) => find(part, side));
      return a === undefined || b === undefined || c === undefined ? null : [a, b, c];
    };
    const [left, right] = [ofSide(-1), ofSide(1)];
    return left === null && right === null ? [] : [{ joint: parts[1], left, right }];
  });
}

/** Returns the angles at all keypoints that two edges meet in, as a finger's or a paw's. */
export function edgeAngles(edges: readonly (readonly [number, number])[]): Triple[] {
  const ends = new Map<number, number[]>();
  for (const [a, b] of edges) {
    for (const [from, to] of [
      [a, b],
      [b, a],
    ] as const) {
      ends.set(from, [...(ends.get(from) ?? []), to]);
    }
  }
  return [...ends].flatMap(([middle, [a, c, ...more]]): Triple[] =>
    a === undefined || c === undefined || more.length > 0 ? [] : [[a, middle, c]],
  );
}

/** Returns what a name of a side may be without the word or the letter of the side. */
function bareWords(name: string): string[] {
  const plain = (text: string) => text.toLowerCase().replace(/[^a-z0-9]/g, "");
  const [bare, whole] = [plain(name.replace(/left|right/i, "")), plain(name)];
  return bare === whole ? [bare.slice(1), bare.slice(0, -1)] : [bare];
}
