/** How far coordinates, lengths and angles may be off: standard deviations by the covariance of a frame's points.
 *
 * That of all points of a frame together is `blockdiag(C_p - M_p M_p') + M M'`: C_p is a point's own, and M (3P, r) is
 * what points share, as the size of the structure. What is measured has the variance `g' Sigma g`, where g are its
 * derivatives by the points that it is measured from: to first order, as GUM (JCGM 100, 5.2.2) propagates it. */

import type { Numbers } from "./numbers.ts";

const DEGREES = 180 / Math.PI;

/** Covariances of points over all frames; NaN where they are not known. */
export interface Covariances {
  readonly covariance: Numbers; // (N, P, 6): xx xy xz yy yz zz
  readonly modes: Numbers; // (N, P, 3, r)
  readonly rank: number; // r
}

/** Returns those of one frame. */
export function ofFrame({ covariance, modes, rank }: Covariances, keypoints: number, frame: number): Covariances {
  const [six, many] = [6 * keypoints, 3 * keypoints * rank];
  return {
    covariance: covariance.subarray(frame * six, (frame + 1) * six),
    modes: modes.subarray(frame * many, (frame + 1) * many),
    rank,
  };
}

type Vector = readonly [number, number, number];

/** Derivatives of what is measured by one of its points. */
interface Part {
  keypoint: number;
  by: Vector;
}

/** Returns the standard deviation of coordinate `axis` (0 x, 1 y, 2 z) of a keypoint: (N,). */
export function coordinateDeviations(
  { covariance }: Covariances,
  keypoints: number,
  keypoint: number,
  axis: number,
): Float64Array {
  const variance = [0, 3, 5][axis]!;
  return Float64Array.from({ length: covariance.length / (6 * keypoints) }, (_, frame) =>
    Math.sqrt(covariance[6 * (frame * keypoints + keypoint) + variance]!),
  );
}

/** Returns the standard deviation of the distance of two keypoints of points (N, P, 3): (N,). */
export function lengthDeviations(
  points: Numbers,
  covariances: Covariances,
  keypoints: number,
  a: number,
  b: number,
): Float64Array {
  return perFrame(points, covariances, keypoints, (at) => {
    const along = unit(between(points, at(a), at(b)));
    return [
      { keypoint: a, by: scaled(along, -1) },
      { keypoint: b, by: along },
    ];
  });
}

/** Returns the standard deviation of the angle at `b` between `a` and `c`: (N,) degrees. */
export function angleDeviations(
  points: Numbers,
  covariances: Covariances,
  keypoints: number,
  a: number,
  b: number,
  c: number,
): Float64Array {
  return perFrame(points, covariances, keypoints, (at) => {
    const [to, from] = [between(points, at(b), at(a)), between(points, at(b), at(c))];
    const normal = unit(cross(to, from));
    // Each end opens the angle where it goes away from the other, across its own edge.
    const byA = scaled(unit(cross(to, normal)), DEGREES / Math.hypot(...to));
    const byC = scaled(unit(cross(normal, from)), DEGREES / Math.hypot(...from));
    const byB = [0, 1, 2].map((axis) => -byA[axis]! - byC[axis]!) as unknown as Vector;
    return [
      { keypoint: a, by: byA },
      { keypoint: b, by: byB },
      { keypoint: c, by: byC },
    ];
  });
}

/** @param derivatives of what is measured, where the numbers of a keypoint begin in `points` */
function perFrame(
  points: Numbers,
  covariances: Covariances,
  keypoints: number,
  derivatives: (at: (keypoint: number) => number) => Part[],
): Float64Array {
  return Float64Array.from({ length: points.length / (3 * keypoints) }, (_, frame) => {
    const first = frame * keypoints;
    const parts = derivatives((keypoint) => 3 * (first + keypoint));
    return Math.sqrt(variance(covariances, first, parts));
  });
}

/** Returns `g' Sigma g`.
 *
 * @param first point of the frame */
function variance({ covariance, modes, rank }: Covariances, first: number, parts: readonly Part[]): number {
  const shared = new Float64Array(rank);
  let own = 0;
  for (const { keypoint, by } of parts) {
    const at = 6 * (first + keypoint);
    const [x, y, z] = by;
    own += x * x * covariance[at]! + y * y * covariance[at + 3]! + z * z * covariance[at + 5]!;
    own += 2 * (x * y * covariance[at + 1]! + x * z * covariance[at + 2]! + y * z * covariance[at + 4]!);
    for (let mode = 0; mode < rank; mode++) {
      let along = 0;
      for (let axis = 0; axis < 3; axis++) along += by[axis]! * modes[(3 * (first + keypoint) + axis) * rank + mode]!;
      own -= along * along;
      shared[mode]! += along;
    }
  }
  return Math.max(
    0,
    shared.reduce((sum, along) => sum + along * along, own),
  ); // NaN stays NaN
}

function between(points: Numbers, from: number, to: number): Vector {
  return [points[to]! - points[from]!, points[to + 1]! - points[from + 1]!, points[to + 2]! - points[from + 2]!];
}

function cross([ax, ay, az]: Vector, [bx, by, bz]: Vector): Vector {
  return [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx];
}

function unit(vector: Vector): Vector {
  return scaled(vector, 1 / Math.hypot(...vector));
}

function scaled([x, y, z]: Vector, by: number): Vector {
  return [x * by, y * by, z * by];
}
