/** Edges of a skeleton that nobody gave: pairs of keypoints whose distance stays the same. */

import type { Numbers } from "./numbers.ts";
import { quantile } from "./worst.ts";

/** The structures of a capture, and which of its frames are there. */
interface Structures {
  frames: number;
  keypoints: number;
  points: Numbers; // (N, P, 3), NaN where there is no answer
  there?: Numbers; // (N,), 0 where nothing is known yet
}

export interface FoundEdge {
  edge: [number, number];
  variation: number; // robust standard deviation of the length beyond the noise, as a share of it
}

const SAMPLES = 300; // frames that are looked at
const LEAST_FRAMES = 10; // in which both ends are known
const MOST_KEYPOINTS = 300; // of more there are too many pairs, and nobody draws them
const FLOOR = 0.01; // a variation below that is noise, and shorter pairs are preferred instead
const LOOSE = 0.25; // what varies more is no bone, and is left out even if a keypoint then stands alone
const AS_GOOD = 1.2; // times the variation of the edges at its ends, up to which a further edge is drawn
const MORE = 0.25; // further edges, as a share of the keypoints
const NOISE = 1.5; // times the noise, below which a length is as constant as any
const DEVIATIONS = 1.4826; // of a normal variable, in one median absolute deviation

/** Returns the edges of a minimum spanning tree over the variations of all pairs' lengths, and a few
 * that are nearly as constant. A variation is the median absolute deviation of the logarithm of the
 * length, less the noise: it does not depend on the unit, and a third of wrong frames does not change
 * it. Noise is as large in short lengths as in long ones, which would seem the more constant. */
export function constantEdges(structures: Structures): FoundEdge[] {
  const { keypoints } = structures;
  if (keypoints < 2 || keypoints > MOST_KEYPOINTS) return [];
  const measures = measured(structures);
  const noise = NOISE * noiseOf(measures, keypoints);
  const pairs = measures.map((pair) => {
    const excess = Math.sqrt(Math.max(0, (pair.variation * pair.length) ** 2 - noise ** 2));
    return { ...pair, variation: excess / pair.length };
  });
  const size = quantile(
    pairs.map((pair) => pair.length),
    0.9,
  );
  const cost = ({ variation, length }: Pair) => Math.hypot(variation, FLOOR) * (1 + length / size);
  const order = pairs.filter(({ variation }) => variation < LOOSE).sort((a, b) => cost(a) - cost(b));
  const groups = Array.from({ length: keypoints }, (_, keypoint) => keypoint);
  const groupOf = (keypoint: number): number => {
    let group = keypoint;
    while (groups[group] !== group) group = groups[group]!;
    return group;
  };
  const tree: Pair[] = [];
  const others: Pair[] = [];
  for (const pair of order) {
    const [a, b] = pair.edge.map(groupOf) as [number, number];
    (a === b ? others : tree).push(pair);
    groups[a] = b;
  }
  const loosest = new Float64Array(keypoints); // variation of the tree's edges at a keypoint
  for (const { edge, variation } of tree) {
    for (const end of edge) loosest[end] = Math.max(loosest[end]!, variation, FLOOR);
  }
  const longest = Math.max(...tree.map((pair) => pair.length));
  const further = others.filter(
    ({ edge: [a, b], variation, length }) =>
      length <= longest && variation <= AS_GOOD * Math.min(loosest[a]!, loosest[b]!),
  );
  return [...tree, ...further.slice(0, Math.floor(MORE * keypoints))].map(({ edge, variation }) => ({
    edge,
    variation,
  }));
}

/** Returns the noise of lengths: each keypoint has some other at a constant distance. */
function noiseOf(pairs: Pair[], keypoints: number): number {
  const least = new Float64Array(keypoints).fill(Infinity);
  for (const { edge, variation, length } of pairs) {
    for (const end of edge) least[end] = Math.min(least[end]!, variation * length);
  }
  return quantile(least, 0.5);
}

interface Pair extends FoundEdge {
  length: number; // median
}

/** Returns all pairs that are known in enough frames, with their lengths. */
function measured({ frames, keypoints, points, there }: Structures): Pair[] {
  const known: number[] = [];
  for (let frame = 0; frame < frames; frame++) if (there === undefined || there[frame]! > 0) known.push(frame);
  const step = Math.max(1, Math.ceil(known.length / SAMPLES));
  const sample = known.filter((_, index) => index % step === 0);
  const pairs: Pair[] = [];
  for (let a = 0; a < keypoints; a++) {
    for (let b = a + 1; b < keypoints; b++) {
      const logs: number[] = [];
      for (const frame of sample) {
        const log = Math.log(distance(points, 3 * (frame * keypoints + a), 3 * (frame * keypoints + b)));
        if (Number.isFinite(log)) logs.push(log);
      }
      if (logs.length < LEAST_FRAMES) continue;
      const middle = quantile(logs, 0.5);
      const deviations = logs.map((log) => Math.abs(log - middle));
      pairs.push({ edge: [a, b], variation: DEVIATIONS * quantile(deviations, 0.5), length: Math.exp(middle) });
    }
  }
  return pairs;
}

function distance(points: Numbers, a: number, b: number): number {
  return Math.hypot(points[a]! - points[b]!, points[a + 1]! - points[b + 1]!, points[a + 2]! - points[b + 2]!);
}
