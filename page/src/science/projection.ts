/** From points to pixels: weak perspective, and OpenCV's two lenses. */

import type { Numbers } from "./numbers.ts";

export const WEAK = 0;
export const FISHEYE = 2;
export const NO_CAMERA = -1;

/** The cameras of N frames of K views, as reconstructions have them. */
export interface Cameras {
  readonly models: Numbers; // (N, K): -1 none, 0 weak perspective, 1 perspective, 2 fisheye
  readonly rotations: Numbers; // (N, K, 3, 3)
  readonly translations: Numbers; // (N, K, 3)
  readonly scales: Numbers; // (N, K) pixels per unit, of weak perspective
  readonly focals: Numbers; // (N, K, 2) pixels
  readonly principalPoints: Numbers; // (N, K, 2) pixels
  readonly distortions: Numbers; // (N, K, 8) k1, k2, p1, p2, k3, k4, k5, k6
}

/** Writes the pixels (P, 2) of points into `into`, NaN where there is no answer.
 *
 * `camera` counts views over all frames: `frame * K + view`. The P points begin at `first` in
 * `points` (3 numbers each). */
export function project(
  cameras: Cameras,
  camera: number,
  points: Numbers,
  first: number,
  count: number,
  into: Float32Array,
): void {
  const model = cameras.models[camera];
  const R = cameras.rotations;
  const r = camera * 9;
  const t = camera * 3;
  const shift = cameras.translations;
  for (let point = 0; point < count; point++) {
    const at = 3 * (first + point);
    const X = points[at]!;
    const Y = points[at + 1]!;
    const Z = points[at + 2]!;
    const x = R[r]! * X + R[r + 1]! * Y + R[r + 2]! * Z;
    const y = R[r + 3]! * X + R[r + 4]! * Y + R[r + 5]! * Z;
    if (model === WEAK) {
      into[2 * point] = cameras.scales[camera]! * x + shift[t]!;
      into[2 * point + 1] = cameras.scales[camera]! * y + shift[t + 1]!;
      continue;
    }
    const z = R[r + 6]! * X + R[r + 7]! * Y + R[r + 8]! * Z + shift[t + 2]!;
    if (model === NO_CAMERA || !(z > 0)) {
      into[2 * point] = into[2 * point + 1] = NaN;
      continue;
    }
    bend(cameras, camera, (x + shift[t]!) / z, (y + shift[t + 1]!) / z, into, 2 * point);
  }
}

/** Writes the pixel of a direction (a, b, 1) of the camera into `into`, at `at`. */
function bend(cameras: Cameras, camera: number, a: number, b: number, into: Float32Array, at: number): void {
  const k = cameras.distortions;
  const d = camera * 8;
  const r2 = a * a + b * b;
  let x: number;
  let y: number;
  if (cameras.models[camera] === FISHEYE) {
    const r = Math.max(Math.sqrt(r2), 1e-12);
    const angle = Math.atan(r);
    const t2 = angle * angle;
    const grown = 1 + t2 * (k[d]! + t2 * (k[d + 1]! + t2 * (k[d + 2]! + t2 * k[d + 3]!)));
    x = (a * angle * grown) / r;
    y = (b * angle * grown) / r;
  } else {
    const radial =
      (1 + r2 * (k[d]! + r2 * (k[d + 1]! + r2 * k[d + 4]!))) /
      (1 + r2 * (k[d + 5]! + r2 * (k[d + 6]! + r2 * k[d + 7]!)));
    const [p1, p2] = [k[d + 2]!, k[d + 3]!];
    x = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a);
    y = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b;
  }
  into[at] = cameras.focals[2 * camera]! * x + cameras.principalPoints[2 * camera]!;
  into[at + 1] = cameras.focals[2 * camera + 1]! * y + cameras.principalPoints[2 * camera + 1]!;
}
