/** Goes along with a subject that walks, so that it stays where the viewer looks. */

import { type PerspectiveCamera, Vector3 } from "three";
import type { OrbitControls } from "three/addons/controls/OrbitControls.js";
import type { Take } from "../../data/take.ts";
import type { Box } from "../../science/extent.ts";

const NEAR = 6; // frames on either side whose middles are averaged, so that no limb shakes the view

/** Returns the middle of the structure about a frame; null where nothing near it has an answer. */
export function middleOf({ points, keypoints, frames }: Take, frame: number): Vector3 | null {
  const sum = new Vector3();
  let count = 0;
  const first = Math.max(0, frame - NEAR);
  const last = Math.min(frames - 1, frame + NEAR);
  for (let at = 3 * keypoints * first; at < 3 * keypoints * (last + 1); at += 3) {
    const x = points[at]!;
    if (!(x === x)) continue; // NaN
    sum.x += x;
    sum.y += points[at + 1]!;
    sum.z += points[at + 2]!;
    count++;
  }
  return count > 0 ? sum.divideScalar(count) : null;
}

/** Returns whether a subject walks so far that to show all of its path would make it small. */
export function walks(path: Box, size: number): boolean {
  return Math.max(path.high[0] - path.low[0], path.high[2] - path.low[2]) > 1.1 * size;
}

/** Returns the box around the subject in one frame. */
export function boxAbout(middle: Vector3, size: number): Box {
  const half = size / 2;
  return {
    low: [middle.x - half, middle.y - half, middle.z - half],
    high: [middle.x + half, middle.y + half, middle.z + half],
  };
}

/** Moves the viewer by as much as the subject has moved. */
export function follow(viewer: PerspectiveCamera, controls: OrbitControls, from: Vector3, to: Vector3): void {
  const step = to.clone().sub(from);
  viewer.position.add(step);
  controls.target.add(step);
}
