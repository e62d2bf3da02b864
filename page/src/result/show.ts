/** What the parts of the result screen share. */

import { createContext } from "preact";
import { useContext } from "preact/hooks";
import type { Finding, Fit, Model, ModelCameras } from "../api/resources.ts";
import type { CaptureFile } from "../data/capture.ts";
import type { Take } from "../data/take.ts";
import type { Theme } from "../parts/theme.ts";
import type { KeypointErrors } from "../science/errors.ts";
import type { Loop } from "./loop.ts";
import type { Overlay } from "./overlay_choice.tsx";
import type { Player } from "./player.ts";

export interface Show {
  fit: Fit;
  model: Model;
  cameras: ModelCameras;
  take: Take;
  player: Player;
  loop: Loop;
  theme: Theme;
  means: Float32Array; // (N,) pixels
  findings: Finding[]; // of the fit and of its frames
  worst: number[]; // frames, the worst first
  overlay: Overlay | null;
  setOverlay(overlay: Overlay | null): void;
  posed: boolean[]; // views that have a perspective pose in some frame
  errors: KeypointErrors;
  errorsDone: boolean;
  file: CaptureFile;
  version: number; // of the take: it rises as frames come
  done: boolean; // whether all frames are there
  trouble: boolean; // whether frames cannot be fetched just now
  selected: number | null; // keypoint
  select(keypoint: number | null): void;
  through: number | null; // view
  lookThrough(view: number | null): void;
}

export const ShowContext = createContext<Show | null>(null);

export function useShow(): Show {
  const show = useContext(ShowContext);
  if (show === null) throw new Error("There is no result here.");
  return show;
}
