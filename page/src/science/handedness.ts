/** On which side of three keypoints a fourth one lies. */

import type { Numbers } from "./numbers.ts";

interface Structures {
  frames: number;
  keypoints: number;
  points: Numbers; // (N, P, 3)
}

/** Returns the share of frames in which (b - a) x (c - a) . (d - a) is positive; NaN if none has all
 * four keypoints. */
export function shareOfPositiveVolumes({ frames, keypoints, points }: Structures, corners: readonly number[]): number {
  let [positive, known] = [0, 0];
  for (let frame = 0; frame < frames; frame++) {
    const [a, b, c, d] = corners.map((corner) => {
      const at = 3 * (frame * keypoints + corner);
      return [points[at]!, points[at + 1]!, points[at + 2]!];
    });
    const [p, q, r] = [b, c, d].map((end) => end!.map((value, axis) => value - a![axis]!));
    const volume =
      r![0]! * (p![1]! * q![2]! - p![2]! * q![1]!) +
      r![1]! * (p![2]! * q![0]! - p![0]! * q![2]!) +
      r![2]! * (p![0]! * q![1]! - p![1]! * q![0]!);
    if (!Number.isFinite(volume)) continue;
    known++;
    if (volume > 0) positive++;
  }
  return positive / known;
}
