/** How far points may be off, in 3D: a pale hull about each, within which it lies with 68 %, and how much of its colour
 * a doubtful point loses. */

import { Color, DynamicDrawUsage, IcosahedronGeometry, InstancedMesh } from "three";
import type { Take } from "../../data/take.ts";
import { colourOf, type Theme } from "../../parts/theme.ts";
import type { Covariances } from "../../science/covariances.ts";
import { litMaterial } from "./lit_material.ts";

const PALE = 0.16; // opacity of a hull
const WITHIN = 1.872; // standard deviations within which 68 % of a Gaussian in three dimensions lie
const CLEAR = 0.015; // of the subject's size: a point that may be off by no more has all of its colour
const LOST = 0.15; // of it: one that may be off by so much has the least

export interface Hulls {
  mesh: InstancedMesh;
  show(frame: number, covariances: Covariances | null): void;
  paint(theme: Theme): void;
}

export function createHulls({ points, deviations, keypoints, sides }: Take): Hulls {
  const mesh = new InstancedMesh(new IcosahedronGeometry(1, 3), litMaterial(PALE), keypoints);
  mesh.instanceMatrix.setUsage(DynamicDrawUsage);
  mesh.frustumCulled = false;
  return {
    mesh,
    show(frame, covariances) {
      const matrices = mesh.instanceMatrix.array;
      for (let keypoint = 0; keypoint < keypoints; keypoint++) {
        const point = frame * keypoints + keypoint;
        const matrix = matrices.subarray(16 * keypoint, 16 * keypoint + 16) as Float32Array;
        const spread = spreadOf(covariances, point, deviations[point]!);
        const known = spread.every(Number.isFinite) && Number.isFinite(points[3 * point]);
        matrix.fill(0);
        if (known) writeHull(matrix, spread, points.subarray(3 * point, 3 * point + 3));
        matrix[15] = 1;
      }
      mesh.instanceMatrix.needsUpdate = true;
    },
    paint(theme) {
      const colour = new Color();
      sides.forEach((side, keypoint) => mesh.setColorAt(keypoint, colour.set(colourOf(theme, side))));
      if (mesh.instanceColor !== null) mesh.instanceColor.needsUpdate = true;
    },
  };
}

/** Returns how much colour each keypoint of a frame loses: (P,) from 0, none, to 1.
 *
 * @param size of the subject */
export function losses({ deviations, keypoints }: Take, frame: number, size: number): Float32Array {
  return Float32Array.from({ length: keypoints }, (_, keypoint) => {
    const share = deviations[frame * keypoints + keypoint]! / size;
    return Number.isNaN(share) ? 0 : Math.min(1, Math.max(0, (share - CLEAR) / (LOST - CLEAR)));
  });
}

/** Returns a point's covariance xx xy xz yy yz zz; where it is not known, that of errors that are as likely in every
 * direction.
 *
 * @param deviation root mean square of its distance from the true one */
function spreadOf(covariances: Covariances | null, point: number, deviation: number): number[] {
  const known = covariances?.covariance.subarray(6 * point, 6 * point + 6);
  if (known !== undefined && Number.isFinite(known[0])) return [...known];
  const alike = deviation ** 2 / 3;
  return [alike, 0, 0, alike, 0, alike];
}

/** Writes the matrix that makes the unit sphere a hull: the Cholesky factor of the covariance, at its place. */
function writeHull(matrix: Float32Array, [xx, xy, xz, yy, yz, zz]: number[], place: Iterable<number>): void {
  const a = Math.sqrt(xx!);
  const [b, c] = a > 0 ? [xy! / a, xz! / a] : [0, 0];
  const d = Math.sqrt(Math.max(0, yy! - b * b));
  const e = d > 0 ? (yz! - b * c) / d : 0;
  const f = Math.sqrt(Math.max(0, zz! - c * c - e * e));
  [a, b, c].forEach((value, row) => (matrix[row] = WITHIN * value));
  [d, e].forEach((value, row) => (matrix[5 + row] = WITHIN * value));
  matrix[10] = WITHIN * f;
  matrix.set([...place], 12);
}
