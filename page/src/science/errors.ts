/** How far detected keypoints are from where the structure projects to. */

import type { Take } from "../data/take.ts";
import { project } from "./projection.ts";

export const OUTLIER = 0.5; // what is above it was left out of the lift
export const UNSEEN = -1; // of a keypoint: no view observes it
export const LEFT_OUT = -2; // of a keypoint: every observation was an outlier

/** Errors of each keypoint of each frame, in pixels: the largest of the views that were used. */
export interface KeypointErrors {
  worst: Float32Array; // (N, P), or UNSEEN, or LEFT_OUT
  outliers: Uint8Array; // (N, P) views whose observation was left out
}

/** Errors that are computed in pieces, between which the browser may draw. */
export interface ErrorWork {
  errors: KeypointErrors;
  /** Adds frames from `first` up to `end` to those that are to be done. */
  add(first: number, end: number): void;
  /** Does a piece; returns whether there is nothing left of what was added. */
  next(): boolean;
}

export function keypointErrors(take: Take): ErrorWork {
  const { frames, keypoints } = take;
  const errors = {
    worst: new Float32Array(frames * keypoints).fill(UNSEEN),
    outliers: new Uint8Array(frames * keypoints),
  };
  const pixels = new Float32Array(2 * keypoints);
  const step = Math.max(1, Math.floor(40_000 / (take.views * keypoints)));
  const waiting: [number, number][] = [];
  return {
    errors,
    add: (first, end) => void waiting.push([first, end]),
    next: () => {
      const range = waiting[0];
      if (range === undefined) return true;
      const end = Math.min(range[1], range[0] + step);
      for (; range[0] < end; range[0]++) ofFrame(take, range[0], errors, pixels);
      if (range[0] === range[1]) waiting.shift();
      return waiting.length === 0;
    },
  };
}

function ofFrame(take: Take, frame: number, errors: KeypointErrors, pixels: Float32Array): void {
  const { views, keypoints, detected, outlierProbability } = take;
  for (let view = 0; view < views; view++) {
    const camera = frame * views + view;
    project(take.cameras, camera, take.points, frame * keypoints, keypoints, pixels);
    for (let keypoint = 0; keypoint < keypoints; keypoint++) {
      const seen = camera * keypoints + keypoint;
      const x = detected[2 * seen]!;
      if (Number.isNaN(x)) continue;
      const at = frame * keypoints + keypoint;
      if (outlierProbability[seen]! > OUTLIER) {
        errors.outliers[at]!++;
        if (errors.worst[at] === UNSEEN) errors.worst[at] = LEFT_OUT;
        continue;
      }
      const dx = x - pixels[2 * keypoint]!;
      const dy = detected[2 * seen + 1]! - pixels[2 * keypoint + 1]!;
      const distance = Math.sqrt(dx * dx + dy * dy);
      if (distance > errors.worst[at]!) errors.worst[at] = distance;
    }
  }
}

/** Returns the mean error of each frame over its views, in pixels; NaN without any. */
export function frameErrors(take: Take): Float32Array {
  const { frames, views, viewErrors } = take;
  const means = new Float32Array(frames);
  for (let frame = 0; frame < frames; frame++) {
    let sum = 0;
    let count = 0;
    for (let view = 0; view < views; view++) {
      const error = viewErrors[frame * views + view]!;
      if (Number.isFinite(error)) {
        sum += error;
        count++;
      }
    }
    means[frame] = count > 0 ? sum / count : NaN;
  }
  return means;
}
