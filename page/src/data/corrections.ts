/** Corrections of keypoints, as they lie over what was detected. */

import type { components } from "../api/openapi.d.ts";
import { ALL, type OpenTake } from "./take.ts";

export type Correction = components["schemas"]["Correction"];
export type Place = components["schemas"]["KeypointPlace"];
export type Position = [number, number];

/** What was corrected of a take: the one place that changes its keypoints after they have come. */
export interface Corrected {
  /** Puts corrections over keypoints (n, K, P, 2) as they were detected, of frames from `first` on. */
  over(detected: Float32Array, first: number): void;
  /** Has what is put from now on show in a take. */
  show(take: OpenTake): void;
  at(place: Place): Correction | undefined;
  list(): Correction[];
  /** Has a keypoint be somewhere, or nowhere, or without a position where it was detected. */
  put(place: Place, position?: Position | null): void;
  /** Shows a keypoint elsewhere until it is put. */
  hold(place: Place, position: Position): void;
}

/** @param known the corrections that there are */
export function createCorrected(shape: { views: number; keypoints: number }, known: readonly Correction[]): Corrected {
  const corrections = new Map(known.map((each) => [keyOf(each), each]));
  const detected = new Map<string, Position>(); // of what lies under something else
  let shown: OpenTake | null = null;
  const numberOf = ({ frame, view, keypoint }: Place, first = 0) =>
    2 * (((frame - first) * shape.views + view) * shape.keypoints + keypoint);

  /** Writes a keypoint of the take, having kept what was there. */
  function write(place: Place, position: Position | null | undefined): void {
    if (shown === null || shown.there[place.frame] !== ALL) return; // it is put over the frame as that comes
    const [key, at] = [keyOf(place), numberOf(place)];
    const own = detected.get(key) ?? [shown.detected[at]!, shown.detected[at + 1]!];
    detected.set(key, own);
    shown.detected.set(position === undefined ? own : (position ?? [NaN, NaN]), at);
  }

  return {
    show(take) {
      shown = take;
    },
    over(pixels, first) {
      const end = first + pixels.length / (2 * shape.views * shape.keypoints);
      for (const [key, each] of corrections) {
        if (each.frame < first || each.frame >= end) continue;
        const at = numberOf(each, first);
        detected.set(key, [pixels[at]!, pixels[at + 1]!]);
        pixels.set(each.position ?? [NaN, NaN], at);
      }
    },
    at: (place) => corrections.get(keyOf(place)),
    list: () =>
      [...corrections.values()].sort((a, b) => a.frame - b.frame || a.view - b.view || a.keypoint - b.keypoint),
    put(place, position) {
      if (position === undefined) corrections.delete(keyOf(place));
      else corrections.set(keyOf(place), { ...placeOf(place), position });
      write(place, position);
    },
    hold: write,
  };
}

export function keyOf({ frame, view, keypoint }: Place): string {
  return `${frame} ${view} ${keypoint}`;
}

export function placeOf({ frame, view, keypoint }: Place): Place {
  return { frame, view, keypoint };
}
