/** Turns points and cameras together, so that y points up and every point keeps its pixel. */

import { WEAK } from "../science/projection.ts";
import type { StructureArrays, Structures } from "./structures.ts";

/** `level`: y up, on the floor where feet are named. `camera`: the axes of the first static camera,
 * turned so that y points up. `view`: each frame in the axes of the first view. */
export type Frame = "level" | "camera" | "view";

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
    const camera = firstCamera(take, frame);
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

/** Returns how the points of a frame are turned to the axes in which a take is shown: (3, 3), row after row; null where
 * they are not.
 *
 * @param structures as they came, not yet placed */
export function turnOf(shown: Frame, structures: Structures, frame: number): number[] | null {
  if (shown === "level") return null;
  const upright = [0, 1, 2].flatMap((row) => [0, 1, 2].map((column) => (row === column ? FLIP[row]! : 0)));
  if (shown === "camera") return upright;
  const camera = firstCamera(structures, frame);
  if (camera === undefined) return null;
  const turn = structures.cameras.rotations.subarray(9 * camera, 9 * camera + 9);
  return Array.from(turn, (value, at) => FLIP[Math.floor(at / 3)]! * value);
}

/** Returns the first camera of a frame that has a pose. */
function firstCamera({ views, cameras }: Structures, frame: number): number | undefined {
  for (let camera = frame * views; camera < (frame + 1) * views; camera++) {
    if (Number.isFinite(cameras.rotations[9 * camera])) return camera;
  }
  return undefined;
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
