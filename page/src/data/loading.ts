/** Loads what the result screen draws first; more comes as it is looked at. */

import {
  getCameras,
  getFitCameras,
  getModel,
  getReconstruction,
  readCorrections,
  type DatasetCorrections,
  type Fit,
  type FitCameras,
  type Model,
  type ModelCameras,
} from "../api/resources.ts";
import { Refusal } from "../api/http.ts";
import type { CaptureFile } from "./capture.ts";
import { createCorrected, type Corrected } from "./corrections.ts";
import { createLoader, partsOf, structures, type Loader } from "./loader.ts";
import type { Frame } from "./placing.ts";
import { remoteCapture } from "./remote.ts";
import { readSafetensors } from "./safetensors.ts";
import { emptyTake, putDetected, putStructures, type Take } from "./take.ts";
import { needed } from "./tensor.ts";

export interface Result {
  take: Take;
  model: Model | null; // null of a first answer
  cameras: ModelCameras | FitCameras;
  file: CaptureFile;
  loader: Loader;
  query: string; // of the frame of reference
  corrected: Corrected;
  corrections: DatasetCorrections; // as they were loaded
  correctionsTag: string | null;
}

/** What structures are wanted in: the best frame of reference that there is, unless it is the canonical one or a
 * direction in the room that is up. */
export interface Axes {
  frame?: "room" | "canonical";
  up?: readonly number[];
}

const MODEL_GONE = "Its model was deleted, and with it the cameras.";
const CAPTURE_GONE = "Its dataset was deleted, and with it what the cameras saw.";

/** A result that can no longer be drawn, because something that it needs was deleted. */
export class Unplayable extends Error {}

/** Returns what is waited for; throws `Unplayable` where it does not exist. */
async function unlessGone<T>(asked: Promise<T>, why: string): Promise<T> {
  try {
    return await asked;
  } catch (error) {
    throw error instanceof Refusal && error.status === 404 ? new Unplayable(why) : error;
  }
}

/** Returns how a frame of reference is asked for. */
export function queryFor(frame: Frame, { up }: Axes = {}): string {
  if (frame === "view") return "";
  return frame === "camera" ? "&frame=room" : `&frame=room&up=${up?.map((value) => value.toFixed(6)).join() ?? "auto"}`;
}

/** Returns the result of a fit that has succeeded, or its first answer: all of a short one, else a few of all frames
 * and those about the first that is shown.
 *
 * @param onAsked called as soon as the service was asked for frames */
export async function loadResult(fit: Fit, firstFrame: number, axes: Axes, onAsked: () => void): Promise<Result> {
  const { model, found } = fit.answer_stage === "geometry" ? firstOf(fit) : modelOf(fit);
  model.catch(() => {}); // it is waited for below
  const [detectedFile, cameras, { found: corrections, tag: correctionsTag }] = await Promise.all([
    unlessGone(remoteCapture(fit.dataset_id, false), CAPTURE_GONE),
    found,
    unlessGone(readCorrections(fit.dataset_id), CAPTURE_GONE),
  ]);
  const corrected = createCorrected(detectedFile.capture, corrections.items);
  const file = correctedFile(detectedFile, corrected);
  const { size, step } = partsOf(fit.frames, file.capture);
  const first = Math.floor(Math.min(Math.max(0, firstFrame), fit.frames - 1) / size) * size;
  const end = Math.min(fit.frames, first + size);
  const detected = file.detected(first, end);
  const frame = axes.frame === "canonical" ? "view" : frameOf(cameras, axes);
  const query = queryFor(frame, axes);
  const load = Promise.all([
    structures(fit.id, query, `${first}:${end}`),
    step > 0 ? structures(fit.id, query, `::${step}`) : null,
  ]);
  onAsked();
  const [[part, overview], seen] = await Promise.all([load, detected]);
  const take = emptyTake(file.capture, fit.frames, frame);
  if (overview !== null) putStructures(take, overview, 0, step);
  putStructures(take, part, first, 1);
  putDetected(take, seen, first);
  corrected.show(take);
  const loader = createLoader(take, file, fit.id, query, first);
  return { take, model: await model, cameras, file, loader, query, corrected, corrections, correctionsTag };
}

interface Modelled {
  model: Promise<Model | null>;
  found: Promise<ModelCameras | FitCameras>;
}

function firstOf(fit: Fit): Modelled {
  return { model: Promise.resolve(null), found: getFitCameras(fit.id) };
}

function modelOf(fit: Fit): Modelled {
  if (fit.model_id === null || fit.model_id === undefined) throw new Unplayable(MODEL_GONE);
  return { model: getModel(fit.model_id), found: unlessGone(getCameras(fit.model_id), MODEL_GONE) };
}

/** Returns a file whose keypoints are corrected as they are read. */
function correctedFile(file: CaptureFile, corrected: Corrected): CaptureFile {
  return {
    ...file,
    async detected(first, end) {
      const pixels = await file.detected(first, end);
      corrected.over(pixels, first);
      return pixels;
    },
  };
}

/** Returns the structures (N, P, 3) of another fit, and whether all are in one frame of reference. */
export async function loadPoints(fit: Fit): Promise<{ points: Float32Array; inOneFrame: boolean }> {
  const cameras = await getCameras(fit.model_id ?? "");
  const frame = frameOf(cameras);
  const found = await getReconstruction(fit.id, queryFor(frame));
  return { points: needed(readSafetensors(found), "points3d"), inOneFrame: frame !== "view" };
}

const FRAMES: Record<ModelCameras["frame_of_reference"], Frame> = {
  upright: "level",
  room: "camera",
  canonical: "view",
};

/** Returns the best frame of reference of a model; it is level, too, where it is given what is up in a room. */
export function frameOf(
  { frame_of_reference: best }: Pick<ModelCameras, "frame_of_reference">,
  { up }: Axes = {},
): Frame {
  return best === "room" && up !== undefined ? "level" : FRAMES[best];
}
