/** What is measured of points (N, P, 3) over all frames; NaN where there is no answer. */

import type { Numbers } from "./numbers.ts";

const DEGREES = 180 / Math.PI;

/** Returns coordinate `axis` (0 x, 1 y, 2 z) of a keypoint: (N,). */
export function coordinates(points: Numbers, keypoints: number, keypoint: number, axis: number): Float64Array {
  return perFrame(points, keypoints, (first) => points[first + 3 * keypoint + axis]!);
}

/** Returns the distance of two keypoints: (N,). */
export function lengths(points: Numbers, keypoints: number, a: number, b: number): Float64Array {
  return perFrame(points, keypoints, (first) => distance(points, first + 3 * a, first + 3 * b));
}

/** Returns the angle at `b` between `a` and `c`: (N,) degrees, 0 to 180. */
export function angles(points: Numbers, keypoints: number, a: number, b: number, c: number): Float64Array {
  return perFrame(points, keypoints, (first) => angle(points, first + 3 * a, first + 3 * b, first + 3 * c));
}

/** Returns how fast a keypoint is: (N,), by second-order differences with the frames beside it, as NumPy's
 * `gradient` takes them, and by the one beside it in the first and in the last frame. Without an answer in
 * one of these frames there is none.
 *
 * @param times (N,) of the frames, in seconds; null counts in frames */
export function speeds(
  points: Numbers,
  keypoints: number,
  keypoint: number,
  times: ArrayLike<number> | null,
): Float64Array {
  const frames = points.length / (3 * keypoints);
  const timeOf = (frame: number) => (times === null ? frame : times[frame]!);
  return perFrame(points, keypoints, (_, frame) => {
    const [before, after] = [Math.max(0, frame - 1), Math.min(frames - 1, frame + 1)];
    const [back, on] = [timeOf(frame) - timeOf(before), timeOf(after) - timeOf(frame)];
    // The derivative of the parabola through three frames or, where one is missing, of a line.
    const weights = back > 0 && on > 0 ? [-on / back, on / back - back / on, back / on] : [-1, 0, 1];
    const span = back + on;
    let sum = 0;
    for (let axis = 0; axis < 3; axis++) {
      const at = (which: number) => points[3 * (which * keypoints + keypoint) + axis]!;
      sum += (weights[0]! * at(before) + weights[1]! * at(frame) + weights[2]! * at(after)) ** 2;
    }
    return span > 0 ? Math.sqrt(sum) / span : NaN;
  });
}

function perFrame(points: Numbers, keypoints: number, measure: (first: number, frame: number) => number): Float64Array {
  const size = 3 * keypoints;
  return Float64Array.from({ length: points.length / size }, (_, frame) => measure(frame * size, frame));
}

function distance(points: Numbers, a: number, b: number): number {
  return Math.hypot(points[a]! - points[b]!, points[a + 1]! - points[b + 1]!, points[a + 2]! - points[b + 2]!);
}

function angle(points: Numbers, a: number, b: number, c: number): number {
  let product = 0;
  for (let axis = 0; axis < 3; axis++) {
    product += (points[a + axis]! - points[b + axis]!) * (points[c + axis]! - points[b + axis]!);
  }
  const cosine = product / (distance(points, a, b) * distance(points, c, b));
  return DEGREES * Math.acos(Math.min(1, Math.max(-1, cosine)));
}
