/** What was noticed of single frames as they were lifted, as findings like those of the fit. */

import type { Finding } from "../api/resources.ts";

type Noticed = Pick<Finding, "code" | "effect" | "remedy"> & { remedy_fields: NonNullable<Finding["remedy_fields"]> };

/** By their bits in the reconstruction's array `findings`. A test holds their fields against the service's. */
export const NOTICED: Record<number, Noticed> = {
  1: {
    code: "rig_not_used",
    effect: "The cameras of the fit do not explain these frames: each view got one of its own.",
    remedy: "Look whether each view is of the camera it is taken for, and whether one was moved.",
    remedy_fields: ["views"],
  },
  2: {
    code: "frame_unlike_fit",
    effect: "These frames are unlike others of the fit: their structures are less sure.",
    remedy: "Fit a capture that has such poses, starting from this model.",
    remedy_fields: ["from_model"],
  },
  4: {
    code: "coordinates_of_another_scale",
    effect: "The coordinates are of another scale than those of the fit.",
    remedy: "Use pixels of images of the size that the fit had.",
    remedy_fields: [],
  },
  8: {
    code: "not_in_room",
    effect: "These frames have no place in the room, so nothing is shown of them.",
    remedy: "Show each frame in axes of its own, or have all frames refined.",
    remedy_fields: ["frame", "refine"],
  },
};
const MOST_RANGES = 100;

export function frameFindings(bits: ArrayLike<number>): Finding[] {
  return Object.entries(NOTICED).flatMap(([bit, noticed]) => {
    const frames = rangesOf(bits.length, (frame) => (bits[frame]! & Number(bit)) !== 0).slice(0, MOST_RANGES);
    if (frames.length === 0) return [];
    return [{ ...noticed, severity: "warning", views: [], frames, keypoints: [], evidence: {} }];
  });
}

/** Returns the ranges of frames, first and last of each, in which something holds. */
export function rangesOf(frames: number, holds: (frame: number) => boolean): [number, number][] {
  const ranges: [number, number][] = [];
  for (let frame = 0; frame < frames; frame++) {
    if (!holds(frame)) continue;
    const last = ranges.at(-1);
    if (last !== undefined && last[1] === frame - 1) last[1] = frame;
    else ranges.push([frame, frame]);
  }
  return ranges;
}
