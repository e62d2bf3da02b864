/** Loads all that the result screen draws. */

import {
  getCameras,
  getCapture,
  getModel,
  getReconstruction,
  type Fit,
  type Model,
  type ModelCameras,
} from "../api/resources.ts";
import { Refusal } from "../api/http.ts";
import { readNpz } from "./npz.ts";
import { readSafetensors } from "./safetensors.ts";
import { needed } from "./tensor.ts";
import { captureOf, takeOf, type Frame, type Take } from "./take.ts";

export interface Result {
  take: Take;
  model: Model;
  cameras: ModelCameras;
}

/** Returns the result of a fit that has succeeded. */
export async function loadResult(fit: Fit): Promise<Result> {
  if (fit.model_id === null || fit.model_id === undefined) {
    throw new Error("The model of this fit was deleted, and with it the cameras.");
  }
  const capture = getCapture(fit.dataset_id).then((bytes) => captureOf(readNpz(bytes)));
  const model = getModel(fit.model_id);
  const cameras = await getCameras(fit.model_id);
  const placed = await placedReconstruction(fit, cameras);
  return {
    take: takeOf(await capture, readSafetensors(placed.bytes), placed.frame),
    model: await model,
    cameras,
  };
}

/** Returns the structures (N, P, 3) of another fit, and whether all are in one frame of reference. */
export async function loadPoints(fit: Fit): Promise<{ points: Float32Array; inOneFrame: boolean }> {
  const { bytes, frame } = await placedReconstruction(fit, await getCameras(fit.model_id ?? ""));
  return { points: needed(readSafetensors(bytes), "points3d"), inOneFrame: frame !== "view" };
}

/** Returns the frames in the best frame of reference that there is. */
async function placedReconstruction(
  fit: Fit,
  cameras: ModelCameras,
): Promise<{ bytes: ArrayBuffer; frame: Frame }> {
  const queries: [Frame, string][] = [["view", ""]];
  if (cameras.views.some((view) => view.resting && view.rotation)) {
    queries.unshift(["level", "&frame=room&up=auto"], ["camera", "&frame=room"]);
  }
  for (const [frame, query] of queries) {
    try {
      return { bytes: await getReconstruction(fit.id, query), frame };
    } catch (error) {
      if (frame === "view" || !(error instanceof Refusal) || error.status !== 409) throw error;
    }
  }
  throw new Error("There is no reconstruction.");
}
