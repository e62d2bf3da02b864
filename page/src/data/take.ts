/** A fitted capture as the result screen draws it: what was detected, and what came of it. */

import type { Cameras } from "../science/projection.ts";
import { sidesOf, type Side } from "../science/sides.ts";
import { axesOfFirstView, yPointsUp } from "./placing.ts";
import type { Npz } from "./npz.ts";
import { floats, needed, type Tensor } from "./tensor.ts";

/** `level`: y up, on the floor where feet are named. `camera`: the axes of the first static camera,
 * turned so that y points up. `view`: each frame in the axes of the first view. */
export type Frame = "level" | "camera" | "view";

export interface Capture {
  frames: number;
  views: number;
  keypoints: number;
  detected: Float32Array; // (N, K, P, 2) pixels, NaN where not observed
  truth?: Float32Array; // (N, P, 3)
  names: string[];
  sides: Side[];
  edges: [number, number][];
  viewNames: string[];
  imageSizes: ([number, number] | null)[];
  fps: number | null;
  times: Float64Array | null; // (N,) seconds
}

export interface Take extends Capture {
  points: Float32Array; // (N, P, 3), y up; NaN where there is no answer
  cameras: Cameras;
  outlierProbability?: Float32Array; // (N, K, P)
  viewErrors: Float32Array; // (N, K) pixels
  frameBits: ArrayLike<number>; // (N,) what was noticed of each frame, a bit a code
  frame: Frame;
}

/** Returns the capture in an npz file of the API. */
export function captureOf(file: Npz): Capture {
  const shape = file.arrays.get("keypoints")?.shape;
  if (shape === undefined) throw new Error("The capture has no keypoints.");
  const [frames, views, keypoints] = shape;
  const names = file.texts.get("keypoint_names") ?? numbered("keypoint", keypoints);
  const sizes = floats(file.arrays, "image_sizes");
  const edges = floats(file.arrays, "edges") ?? new Float32Array();
  return {
    frames,
    views,
    keypoints,
    detected: needed(file.arrays, "keypoints"),
    truth: floats(file.arrays, "points3d"),
    names,
    sides: sidesOf(names),
    edges: Array.from({ length: edges.length / 2 }, (_, i) => [edges[2 * i], edges[2 * i + 1]]),
    viewNames: file.texts.get("view_names") ?? numbered("view", views),
    imageSizes: Array.from({ length: views }, (_, view) =>
      sizes !== undefined && sizes[2 * view] > 0 ? [sizes[2 * view], sizes[2 * view + 1]] : null,
    ),
    fps: floats(file.arrays, "fps")?.[0] ?? null,
    times: firstViewsTimes(file.arrays.get("times"), frames),
  };
}

/** Returns the take of a capture and its reconstruction, placed so that y points up. */
export function takeOf(capture: Capture, file: Map<string, Tensor>, frame: Frame): Take {
  const points = needed(file, "points3d");
  const frames = points.length / (3 * capture.keypoints);
  const models = file.get("camera_models");
  if (models === undefined) throw new Error("The reconstruction has no cameras.");
  const cameras: Cameras = {
    models: models.data,
    rotations: needed(file, "rotations"),
    translations: needed(file, "translations"),
    scales: needed(file, "scales"),
    focals: needed(file, "focals"),
    principalPoints: needed(file, "principal_points"),
    distortions: needed(file, "distortions"),
  };
  const take: Take = {
    ...capture,
    frames, // a fit sees the frames that its dataset had then
    points,
    cameras,
    outlierProbability: floats(file, "outlier_probability"),
    viewErrors: needed(file, "reprojection_errors"),
    frameBits: file.get("findings")?.data ?? [],
    frame,
  };
  if (frame === "camera") yPointsUp(take);
  if (frame === "view") axesOfFirstView(take);
  return take;
}

/** Returns frames per second, and whether they are known or merely usual. */
export function rateOf(capture: Capture): { rate: number; known: boolean } {
  if (capture.fps !== null) return { rate: capture.fps, known: true };
  const times = capture.times;
  if (times !== null && times.length > 1) {
    const span = times[times.length - 1] - times[0];
    if (span > 0) return { rate: (times.length - 1) / span, known: true };
  }
  return { rate: 30, known: false };
}

function numbered(word: string, count: number): string[] {
  return Array.from({ length: count }, (_, index) => `${word} ${index}`);
}

function firstViewsTimes(times: Tensor | undefined, frames: number): Float64Array | null {
  if (times === undefined) return null;
  const views = times.shape[1] ?? 1;
  return Float64Array.from({ length: frames }, (_, frame) => times.data[frame * views]);
}
