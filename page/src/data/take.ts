/** A fitted capture as the result screen draws it: what was detected, and what came of it. */

import type { Numbers } from "../science/numbers.ts";
import type { Capture } from "./capture.ts";
import { axesOfFirstView, yPointsUp, type Frame } from "./placing.ts";
import type { CameraArrays, StructureArrays, Structures } from "./structures.ts";
import { floats, needed, type Tensor } from "./tensor.ts";

/** What there is of a frame so far. */
export const NOTHING = 0;
export const STRUCTURE = 1;
export const ALL = 2;

/** A take as screens read it. Its frames come by and by, into the arrays that it has from the beginning: a number
 * (`version` in `result/show.ts`) rises when some have come, and what was made of the arrays is made anew. */
export interface Take extends Capture, Structures {
  readonly detected: Numbers; // (N, K, P, 2) pixels, NaN where not observed; of frames that are ALL there
  readonly outlierProbability: Numbers; // (N, K, P), NaN where nothing was judged
  readonly viewErrors: Numbers; // (N, K) pixels
  readonly deviations: Numbers; // (N, P) how far each point may be off, NaN where it is not known
  readonly frameBits: Numbers; // (N,) what was noticed of each frame, a bit a code
  readonly frame: Frame;
  readonly there: Numbers; // (N,) NOTHING, STRUCTURE or ALL
}

/** The same take as it is written: by the loader of a result, or by the feed of a stream, which made it. They alone
 * have it as this, and hand it on as a `Take`. */
export interface OpenTake extends Take, StructureArrays {
  readonly points: Float32Array;
  readonly cameras: CameraArrays;
  readonly detected: Float32Array;
  readonly outlierProbability: Float32Array;
  readonly viewErrors: Float32Array;
  readonly deviations: Float32Array;
  readonly frameBits: Uint8Array;
  readonly there: Uint8Array;
}

/** Returns a take that has no frames yet. What is large is not filled with NaN, which takes long: what
 * was detected is of frames that are there, and a camera without a model is none.
 *
 * @param frames of the fit: it sees those that its dataset had then */
export function emptyTake(capture: Capture, frames: number, frame: Frame): OpenTake {
  const { views, keypoints } = capture;
  const unknown = (size: number) => new Float32Array(size).fill(NaN);
  const numbers = (size: number) => new Float32Array(size);
  const cameras = frames * views;
  return {
    ...capture,
    frames,
    frame,
    detected: numbers(2 * cameras * keypoints),
    points: unknown(3 * frames * keypoints),
    cameras: {
      models: new Int8Array(cameras).fill(-1),
      rotations: numbers(9 * cameras),
      translations: numbers(3 * cameras),
      scales: numbers(cameras),
      focals: numbers(2 * cameras),
      principalPoints: numbers(2 * cameras),
      distortions: numbers(8 * cameras),
    },
    outlierProbability: numbers(cameras * keypoints),
    viewErrors: unknown(cameras),
    deviations: unknown(frames * keypoints),
    frameBits: new Uint8Array(frames),
    there: new Uint8Array(frames),
  };
}

/** Structures, and what is known of them besides. */
export interface Lifted extends StructureArrays {
  readonly outliers: ArrayLike<number> | undefined; // (N, K, P)
  readonly errors: Float32Array; // (N, K) pixels
  readonly bits: ArrayLike<number> | undefined; // (N,)
  readonly deviations?: ArrayLike<number> | undefined; // (N, P)
}

/** Puts frames of a reconstruction into a take: `first`, `first + step` and so on. */
export function putStructures(take: OpenTake, file: Map<string, Tensor>, first: number, step: number): void {
  const outliers = floats(file, "outlier_probability");
  const errors = needed(file, "reprojection_errors");
  const deviations = floats(file, "points3d_sd");
  const bits = file.get("findings")?.data;
  putLifted(take, { ...structuresOf(take, file), outliers, errors, bits, deviations }, first, step);
}

/** Places frames as those of the take are, and puts them there. */
export function putLifted(take: OpenTake, part: Lifted, first: number, step: number): void {
  if (take.frame === "camera") yPointsUp(part);
  if (take.frame === "view") axesOfFirstView(part);
  const { cameras } = take;
  const put = (into: Float32Array | Int8Array | Uint8Array, from: ArrayLike<number> | undefined) => {
    if (from !== undefined) putFrames(into, from, part.frames, first, step);
  };
  put(take.points, part.points);
  for (const name of Object.keys(cameras) as (keyof CameraArrays)[]) put(cameras[name], part.cameras[name]);
  put(take.outlierProbability, part.outliers);
  put(take.viewErrors, part.errors);
  put(take.deviations, part.deviations);
  put(take.frameBits, part.bits);
  for (let frame = first, left = part.frames; left > 0; frame += step, left--) {
    take.there[frame] = Math.max(take.there[frame]!, STRUCTURE);
  }
}

export function structuresOf({ views, keypoints }: Take, file: Map<string, Tensor>): StructureArrays {
  const points = needed(file, "points3d");
  const models = file.get("camera_models");
  if (models === undefined) throw new Error("The reconstruction has no cameras.");
  const cameras = {
    models: models.data as Int8Array,
    rotations: needed(file, "rotations"),
    translations: needed(file, "translations"),
    scales: needed(file, "scales"),
    focals: needed(file, "focals"),
    principalPoints: needed(file, "principal_points"),
    distortions: needed(file, "distortions"),
  };
  return { frames: points.length / (3 * keypoints), views, keypoints, points, cameras };
}

/** Copies frames into an array that has `step` times as many. */
function putFrames(
  into: Float32Array | Int8Array | Uint8Array,
  from: ArrayLike<number>,
  frames: number,
  first: number,
  step: number,
): void {
  const size = from.length / frames;
  if (step === 1) return into.set(from, first * size);
  for (let frame = 0; frame < frames; frame++) {
    const at = (first + frame * step) * size;
    for (let i = 0; i < size; i++) into[at + i] = from[frame * size + i]!;
  }
}

/** Puts what was detected into frames from `first` on, which then are all there. */
export function putDetected(take: OpenTake, detected: Float32Array, first: number): void {
  const size = 2 * take.views * take.keypoints;
  take.detected.set(detected, first * size);
  take.there.fill(ALL, first, first + detected.length / size);
}

/** Returns the frame to draw in the place of one: itself or, until it is there, one before it. */
export function nearest({ there }: Take, frame: number): number {
  for (let near = frame; near >= 0; near--) if (there[near] !== NOTHING) return near;
  return frame;
}

/** Returns whether it is known of any point how far it may be off. */
export function knowsDeviations({ deviations }: Take): boolean {
  for (let at = 0; at < deviations.length; at++) if (Number.isFinite(deviations[at])) return true;
  return false;
}
