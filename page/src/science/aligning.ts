/** Lays one set of points over another: the similarity (rotation, scale, shift) nearest to it. */

import type { Numbers } from "./numbers.ts";

/** Row after row. */
type Matrix3 = [number, number, number, number, number, number, number, number, number];

/** Writes `from` (N, P, 3), moved onto `to`, into the result; NaN where `from` is. With `each` every
 * frame is moved on its own, else all of them as one.
 *
 * Horn, Closed-form solution of absolute orientation using unit quaternions (1987). */
export function aligned(from: Numbers, to: Numbers, keypoints: number, each: boolean): Float32Array {
  const moved = new Float32Array(to.length).fill(NaN);
  const size = each ? 3 * keypoints : to.length;
  for (let start = 0; start < to.length; start += size) {
    const end = Math.min(start + size, from.length, to.length);
    align(from, to, start, end, moved);
  }
  return moved;
}

function align(from: Numbers, to: Numbers, start: number, end: number, moved: Float32Array): void {
  const pairs: number[] = [];
  for (let at = start; at < end; at += 3) {
    if (Number.isFinite(from[at]! + to[at]!)) pairs.push(at);
  }
  if (pairs.length < 3) return;
  const a = meanOf(from, pairs);
  const b = meanOf(to, pairs);
  const S: Matrix3 = [0, 0, 0, 0, 0, 0, 0, 0, 0]; // of the first's coordinate i and the second's j
  let [spread, reach] = [0, 0];
  for (const at of pairs) {
    for (let i = 0; i < 3; i++) {
      const p = from[at + i]! - a[i]!;
      spread += p * p;
      reach += (to[at + i]! - b[i]!) ** 2;
      for (let j = 0; j < 3; j++) S[3 * i + j]! += p * (to[at + j]! - b[j]!);
    }
  }
  const R = rotationOf(S);
  const scale = Math.sqrt(reach / spread);
  for (let at = start; at < end; at += 3) {
    for (let row = 0; row < 3; row++) {
      let sum = 0;
      for (let i = 0; i < 3; i++) sum += R[3 * row + i]! * (from[at + i]! - a[i]!);
      moved[at + row] = scale * sum + b[row]!;
    }
  }
}

function meanOf(points: Numbers, pairs: number[]): number[] {
  const sum = [0, 0, 0];
  for (const at of pairs) for (let i = 0; i < 3; i++) sum[i]! += points[at + i]!;
  return sum.map((value) => value / pairs.length);
}

/** Returns the rotation (3 x 3) that turns the first points of a covariance best onto the second. */
function rotationOf([xx, xy, xz, yx, yy, yz, zx, zy, zz]: Matrix3): Matrix3 {
  // prettier-ignore
  const N = [
    xx + yy + zz, yz - zy, zx - xz, xy - yx,
    yz - zy, xx - yy - zz, xy + yx, zx + xz,
    zx - xz, xy + yx, yy - xx - zz, yz + zy,
    xy - yx, zx + xz, yz + zy, zz - xx - yy,
  ];
  const [w, x, y, z] = largestEigenvector(N);
  // prettier-ignore
  return [
    w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z,
  ];
}

const SWEEPS = 12; // Jacobi's of a 4 x 4 matrix converge in five or six

/** Returns the unit eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix (Jacobi). */
function largestEigenvector(matrix: number[]): [number, number, number, number] {
  const A = [...matrix];
  const V = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  for (let sweep = 0; sweep < SWEEPS; sweep++) {
    for (let p = 0; p < 3; p++) {
      for (let q = p + 1; q < 4; q++) rotate(A, V, p, q);
    }
  }
  const best = [0, 1, 2, 3].reduce((a, b) => (A[5 * b]! > A[5 * a]! ? b : a));
  return [V[best]!, V[4 + best]!, V[8 + best]!, V[12 + best]!];
}

/** Makes the elements (p, q) and (q, p) zero. */
function rotate(A: number[], V: number[], p: number, q: number): void {
  if (A[4 * p + q] === 0) return;
  const angle = (A[5 * q]! - A[5 * p]!) / (2 * A[4 * p + q]!);
  const t = Math.sign(angle || 1) / (Math.abs(angle) + Math.hypot(angle, 1));
  const c = 1 / Math.hypot(t, 1);
  const s = t * c;
  for (let k = 0; k < 4; k++) {
    [A[4 * k + p], A[4 * k + q]] = [c * A[4 * k + p]! - s * A[4 * k + q]!, s * A[4 * k + p]! + c * A[4 * k + q]!];
  }
  for (let k = 0; k < 4; k++) {
    [A[4 * p + k], A[4 * q + k]] = [c * A[4 * p + k]! - s * A[4 * q + k]!, s * A[4 * p + k]! + c * A[4 * q + k]!];
    [V[4 * k + p], V[4 * k + q]] = [c * V[4 * k + p]! - s * V[4 * k + q]!, s * V[4 * k + p]! + c * V[4 * k + q]!];
  }
}

/** Returns the mean distance of each frame's points (N,); NaN where none has a partner. */
export function distances(a: Numbers, b: Numbers, keypoints: number): Float32Array {
  const size = 3 * keypoints;
  return Float32Array.from({ length: Math.floor(a.length / size) }, (_, frame) => {
    let [sum, count] = [0, 0];
    for (let at = frame * size; at < (frame + 1) * size; at += 3) {
      const distance = Math.hypot(a[at]! - b[at]!, a[at + 1]! - b[at + 1]!, a[at + 2]! - b[at + 2]!);
      if (distance === distance) {
        sum += distance;
        count++;
      }
    }
    return count > 0 ? sum / count : NaN;
  });
}
