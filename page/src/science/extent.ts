/** How large things are, and where they lie. */

import type { Numbers } from "./numbers.ts";
import { quantile } from "./worst.ts";

export interface Box {
  low: [number, number, number];
  high: [number, number, number];
}

const SAMPLES = 400; // frames that are looked at,
const SAMPLED_POINTS = 6000; // but no more than have so many points
const ASTRAY = 0.01; // share of coordinates at either end that does not count

/** Returns the box of points (N, P, 3) over all frames, without those that lie far astray.
 *
 * @param there which frames are known, if not all are */
export function boxOf(points: Numbers, keypoints: number, there?: Numbers): Box {
  const axes: number[][] = [[], [], []];
  for (const frame of sampled(points.length / (3 * keypoints), keypoints, there)) {
    for (let at = 3 * keypoints * frame; at < 3 * keypoints * (frame + 1); at += 3) {
      if (Number.isNaN(points[at])) continue;
      for (let axis = 0; axis < 3; axis++) axes[axis]!.push(points[at + axis]!);
    }
  }
  const low = axes.map((values) => quantile(values, ASTRAY));
  const high = axes.map((values) => quantile(values, 1 - ASTRAY));
  return { low: low as Box["low"], high: high as Box["high"] };
}

/** Returns the size of the subject: the median diagonal of a frame's box. */
export function subjectSize(points: Numbers, keypoints: number, there?: Numbers): number {
  const diagonals: number[] = [];
  for (const frame of sampled(points.length / (3 * keypoints), keypoints, there)) {
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    for (let at = 3 * keypoints * frame; at < 3 * keypoints * (frame + 1); at += 3) {
      if (Number.isNaN(points[at])) continue;
      for (let axis = 0; axis < 3; axis++) {
        low[axis] = Math.min(low[axis]!, points[at + axis]!);
        high[axis] = Math.max(high[axis]!, points[at + axis]!);
      }
    }
    const diagonal = Math.hypot(high[0]! - low[0]!, high[1]! - low[1]!, high[2]! - low[2]!);
    if (Number.isFinite(diagonal)) diagonals.push(diagonal);
  }
  return quantile(diagonals, 0.5) || 1;
}

/** Returns how far keypoints go from one frame to the next, in most frames. */
export function usualStep(points: Numbers, keypoints: number, there?: Numbers): number {
  const size = 3 * keypoints;
  const followed = there && Uint8Array.from(there, (known, frame) => (there[frame + 1] ? known : 0));
  const steps = sampled(points.length / size - 1, keypoints, followed).map((frame) => {
    let [sum, count] = [0, 0];
    for (let at = frame * size; at < (frame + 1) * size; at += 3) {
      const step = Math.hypot(
        points[at + size]! - points[at]!,
        points[at + size + 1]! - points[at + 1]!,
        points[at + size + 2]! - points[at + 2]!,
      );
      if (step === step) {
        sum += step;
        count++;
      }
    }
    return sum / count;
  });
  return quantile(steps, 0.5);
}

/** Returns the length near to `length` that people count in: 1, 2 or 5 times a power of ten. */
export function roundLength(length: number): number {
  const power = 10 ** Math.floor(Math.log10(length));
  const digit = length / power;
  return power * (digit < 1.5 ? 1 : digit < 3.5 ? 2 : digit < 7.5 ? 5 : 10);
}

function sampled(frames: number, keypoints: number, there?: Numbers): number[] {
  const known: number[] = [];
  for (let frame = 0; frame < frames; frame++) if (there === undefined || there[frame]! > 0) known.push(frame);
  const step = Math.max(1, Math.floor(known.length / Math.min(SAMPLES, SAMPLED_POINTS / keypoints)));
  return known.filter((_, index) => index % step === 0);
}
