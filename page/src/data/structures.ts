/** Structures of some frames, and the cameras that see them: as they are read, and as they are written. */

import type { Numbers } from "../science/numbers.ts";
import type { Cameras } from "../science/projection.ts";

export interface Structures {
  readonly frames: number;
  readonly views: number;
  readonly keypoints: number;
  readonly points: Numbers; // (N, P, 3), y up; NaN where there is no answer
  readonly cameras: Cameras;
}

/** Cameras whose arrays may be written. */
export interface CameraArrays extends Cameras {
  readonly models: Int8Array;
  readonly rotations: Float32Array;
  readonly translations: Float32Array;
  readonly scales: Float32Array;
  readonly focals: Float32Array;
  readonly principalPoints: Float32Array;
  readonly distortions: Float32Array;
}

/** Structures whose arrays may be written. */
export interface StructureArrays extends Structures {
  readonly points: Float32Array;
  readonly cameras: CameraArrays;
}
