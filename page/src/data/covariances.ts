/** Covariances of the points of a take, placed as its points are. The service computes them when they are asked for. */

import { Refusal } from "../api/http.ts";
import { getReconstruction } from "../api/resources.ts";
import type { Covariances } from "../science/covariances.ts";
import { turnOf } from "./placing.ts";
import { readSafetensors } from "./safetensors.ts";
import { structuresOf, type Take } from "./take.ts";
import { floats, type Tensor } from "./tensor.ts";

const TOO_LONG = "The capture is longer than the service computes it for at once.";

/** Fetches covariances of all frames of a fit; null where it has none. Throws where they are more than the service
 * sends.
 *
 * @param query of the frame of reference */
export async function loadCovariances(fit: string, take: Take, query: string): Promise<Covariances | null> {
  try {
    return readCovariances(take, readSafetensors(await getReconstruction(fit, `${query}&uncertainty=full`)));
  } catch (error) {
    throw error instanceof Refusal && error.status === 422 ? new Error(TOO_LONG) : error;
  }
}

/** Reads covariances of all frames from a reconstruction. */
export function readCovariances(take: Take, file: Map<string, Tensor>): Covariances | null {
  const covariance = floats(file, "points3d_covariance");
  const modes = floats(file, "points3d_modes");
  if (covariance === undefined || modes === undefined) return null;
  const rank = modes.length / (covariance.length / 2);
  const structures = structuresOf(take, file);
  const size = take.keypoints;
  for (let frame = 0; frame < structures.frames; frame++) {
    const turn = turnOf(take.frame, structures, frame);
    if (turn === null) continue;
    turnSymmetric(turn, covariance.subarray(6 * frame * size, 6 * (frame + 1) * size));
    turnModes(turn, modes.subarray(3 * frame * size * rank, 3 * (frame + 1) * size * rank), rank);
  }
  return { covariance, modes, rank };
}

/** Makes each C of (P, 6: xx xy xz yy yz zz) T C T'. */
function turnSymmetric(turn: ArrayLike<number>, covariance: Float32Array): void {
  const full = [0, 1, 2, 1, 3, 4, 2, 4, 5];
  for (let at = 0; at < covariance.length; at += 6) {
    const before = covariance.slice(at, at + 6);
    let place = at;
    for (let row = 0; row < 3; row++) {
      for (let column = row; column < 3; column++) {
        let sum = 0;
        for (let i = 0; i < 3; i++) {
          for (let j = 0; j < 3; j++) sum += turn[3 * row + i]! * before[full[3 * i + j]!]! * turn[3 * column + j]!;
        }
        covariance[place++] = sum;
      }
    }
  }
}

/** Makes each U of (P, 3, r) T U. */
function turnModes(turn: ArrayLike<number>, modes: Float32Array, rank: number): void {
  for (let at = 0; at < modes.length; at += 3 * rank) {
    const before = modes.slice(at, at + 3 * rank);
    for (let row = 0; row < 3; row++) {
      for (let mode = 0; mode < rank; mode++) {
        let sum = 0;
        for (let axis = 0; axis < 3; axis++) sum += turn[3 * row + axis]! * before[axis * rank + mode]!;
        modes[at + row * rank + mode] = sum;
      }
    }
  }
}
