/** What the parts of a screen that shows structures share. */

import { createContext } from "preact";
import { useContext } from "preact/hooks";
import type { Finding, Fit, FitCameras, Model, ModelCameras } from "../api/resources.ts";
import type { CaptureFile } from "../data/capture.ts";
import type { Take } from "../data/take.ts";
import type { Theme } from "../parts/theme.ts";
import type { KeypointErrors } from "../science/errors.ts";
import type { Numbers } from "../science/numbers.ts";
import type { Editing } from "./correcting/use_editing.ts";
import type { Loop } from "./loop.ts";
import type { Player } from "./player.ts";
import type { Selection } from "./selection.ts";
import type { KnownCovariances } from "./use_covariances.ts";

/** Edges that are drawn in the place of the skeleton's: some that are being drawn, or some that are offered. */
export interface Joined {
  edges: readonly (readonly [number, number])[];
  offered: boolean;
}

/** Structures, whether they are stored or come just now. */
export interface Shown extends Selection {
  unit: string; // of lengths, in words
  take: Take;
  player: Player;
  loop: Loop;
  theme: Theme;
  posed: boolean[]; // views that have a perspective pose in some frame
  version: number; // of the take: it rises as frames come
  done: boolean; // whether all frames are there
  covariances: KnownCovariances;
  joined: Joined | null; // null: the edges are those of the skeleton
  through: number | null; // view
  lookThrough(view: number | null): void;
  editing: Editing | null; // null where keypoints cannot be corrected
}

/** What is laid over the structure. */
export interface Overlay {
  name: string;
  points: Numbers; // (N, P, 3), moved onto the structure
  each: boolean; // whether each frame was moved on its own, not all as one
  model: Model | null; // that made them
}

/** The result of a fit. */
export interface Show extends Shown {
  fit: Fit;
  editing: Editing;
  model: Model | null; // null of a first answer
  cameras: ModelCameras | FitCameras;
  file: CaptureFile;
  query: string; // of the frame of reference, for what is asked of the service
  join(joined: Joined | null): void;
  means: Float32Array; // (N,) pixels
  findings: Finding[]; // of the fit and of its frames
  worst: number[]; // frames, the worst first
  overlay: Overlay | null;
  setOverlay(overlay: Overlay | null): void;
  errors: KeypointErrors;
  errorsDone: boolean;
  trouble: boolean; // whether frames cannot be fetched just now
}

export const ShownContext = createContext<Shown | null>(null);
export const ShowContext = createContext<Show | null>(null);

export function useShown(): Shown {
  return found(useContext(ShownContext));
}

export function useShow(): Show {
  return found(useContext(ShowContext));
}

function found<T>(shared: T | null): T {
  if (shared === null) throw new Error("Nothing is shown here.");
  return shared;
}
