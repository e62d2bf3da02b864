/** What was noticed of single frames as they were lifted, as findings like those of the fit. */

import type { Finding } from "../api/resources.ts";

/** A bit for each code in the reconstruction's array `findings`, and what it leads to. */
const BITS: [number, Finding["code"], string][] = [
  [1, "rig_not_used", "The cameras of the fit do not explain these frames: each view got one of its own."],
  [2, "frame_unlike_fit", "These frames are unlike others of the fit: their structures are less sure."],
  [4, "coordinates_of_another_scale", "The coordinates are of another scale than those of the fit."],
  [8, "not_in_room", "These frames have no place in the room, so nothing is shown of them."],
];
const MOST_RANGES = 100;

export function frameFindings(bits: ArrayLike<number>): Finding[] {
  return BITS.flatMap(([bit, code, effect]) => {
    const frames = rangesOf(bits.length, (frame) => (bits[frame]! & bit) !== 0).slice(0, MOST_RANGES);
    if (frames.length === 0) return [];
    return [{ code, severity: "warning", views: [], frames, keypoints: [], evidence: {}, effect, remedy: "" }];
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
