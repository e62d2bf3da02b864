/** Turns points and cameras together, so that y points up and every point keeps its pixel. */

import { WEAK } from "../science/projection.ts";
import type { StructureArrays } from "./structures.ts";

const FLIP = [1, -1, -1]; // from a camera's axes (y down, z forward) to those with y up

/** Turns the frame of a camera, all frames alike. */
export function yPointsUp(take: StructureArrays): void {
  for (let at = 0; at < take.points.length; at++) take.points[at]! *= FLIP[at % 3]!;
  const turns = take.cameras.rotations;
  for (let at = 0; at < turns.length; at++) turns[at]! *= FLIP[at % 3]!; // columns of R
}

/** Puts each frame into the axes of its first view: its own cameras say where it is. */
export function axesOfFirstView(take: StructureArrays): void {
  const { points, cameras, views, keypoints } = take;
  const { rotations, translations, models } = cameras;
  for (let frame = 0; frame < take.frames; frame++) {
    const camera = Array.from({ length: views }, (_, view) => frame * views + view).find((which) =>
      Number.isFinite(rotations[9 * which]),
    );
    if (camera === undefined) continue;
    const turn = rotations.slice(9 * camera, 9 * camera + 9);
    const weak = models[camera] === WEAK;
    const shift = weak ? [0, 0, 0] : [...translations.slice(3 * camera, 3 * camera + 3)];
    const first = 3 * keypoints * frame;
    for (let at = first; at < first + 3 * keypoints; at += 3) {
      const moved = multiply(turn, points.slice(at, at + 3));
      for (let axis = 0; axis < 3; axis++) {
        points[at + axis] = FLIP[axis]! * (moved[axis]! + shift[axis]!);
      }
    }
    for (let view = 0; view < views; view++) turnView(take, frame * views + view, turn, shift);
  }
}

/** Has a camera see the points where `X' = F (T X + s)` put them: `R' = R T^t F`, `t' = t - R T^t s`.
 */
function turnView(take: StructureArrays, camera: number, turn: Float32Array, shift: number[]): void {
  const { rotations, translations, models, scales } = take.cameras;
  const old = rotations.slice(9 * camera, 9 * camera + 9);
  const size = models[camera] === WEAK ? scales[camera]! : 1;
  for (let row = 0; row < 3; row++) {
    let moved = 0;
    for (let column = 0; column < 3; column++) {
      let sum = 0;
      for (let k = 0; k < 3; k++) sum += old[3 * row + k]! * turn[3 * column + k]!;
      moved += sum * shift[column]!;
      rotations[9 * camera + 3 * row + column] = sum * FLIP[column]!;
    }
    translations[3 * camera + row]! -= size * moved;
  }
}

function multiply(matrix: Float32Array, vector: Float32Array): number[] {
  return [0, 3, 6].map(
    (row) => matrix[row]! * vector[0]! + matrix[row + 1]! * vector[1]! + matrix[row + 2]! * vector[2]!,
  );
}
