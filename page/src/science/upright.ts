/** Which direction of the room is up, by two keypoints one of which is above the other. */

import type { Take } from "../data/take.ts";

const RIG_NOT_USED = 1; // a frame's bit: its cameras are not those of the fit

/** Returns the mean direction from one keypoint to another over the frames, in the axes of the room without any
 * up; null where no frame shows it.
 *
 * @param view a static one
 * @param rotation (3, 3) from the room to the view */
export function directionInRoom(
  { frames, views, keypoints, points, cameras, frameBits }: Take,
  [from, to]: readonly [number, number],
  view: number,
  rotation: readonly (readonly number[])[],
): number[] | null {
  const mean = [0, 0, 0];
  for (let frame = 0; frame < frames; frame++) {
    const camera = frame * views + view;
    if ((frameBits[frame]! & RIG_NOT_USED) !== 0 || cameras.models[camera]! < 0) continue;
    const [a, b] = [3 * (frame * keypoints + from), 3 * (frame * keypoints + to)];
    const shown = [0, 1, 2].map((axis) => points[b + axis]! - points[a + axis]!);
    const length = Math.hypot(...shown);
    if (!(length > 0)) continue;
    // From the axes that are shown to those of the view, and from there to the room's.
    const seen = [0, 3, 6].map((row) =>
      shown.reduce((sum, value, axis) => sum + cameras.rotations[9 * camera + row + axis]! * value, 0),
    );
    for (let axis = 0; axis < 3; axis++) {
      mean[axis]! += seen.reduce((sum, value, row) => sum + rotation[row]![axis]! * value, 0) / length;
    }
  }
  const length = Math.hypot(...mean);
  return length > 0 ? mean.map((value) => value / length) : null;
}
