/** The keypoint of a frame that is farthest from where the structure projects to, outliers too. */

import type { Take } from "../data/take.ts";
import { project } from "./projection.ts";

export interface Farthest {
  view: number;
  keypoint: number;
  pixels: number;
}

/** Returns it; null of a frame in which nothing was detected, or nothing lifted. */
export function farthestOf(take: Take, frame: number): Farthest | null {
  const { views, keypoints, detected } = take;
  const projected = new Float32Array(2 * keypoints);
  let farthest: Farthest | null = null;
  for (let view = 0; view < views; view++) {
    const camera = frame * views + view;
    project(take.cameras, camera, take.points, frame * keypoints, keypoints, projected);
    for (let keypoint = 0; keypoint < keypoints; keypoint++) {
      const seen = 2 * (camera * keypoints + keypoint);
      const pixels = Math.hypot(
        detected[seen]! - projected[2 * keypoint]!,
        detected[seen + 1]! - projected[2 * keypoint + 1]!,
      );
      if (pixels > (farthest?.pixels ?? 0)) farthest = { view, keypoint, pixels }; // false for NaN
    }
  }
  return farthest;
}
