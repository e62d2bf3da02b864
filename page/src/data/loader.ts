/** Fetches the frames of a take: first a few of all, then those that are looked at, then the others. */

import { getReconstruction } from "../api/resources.ts";
import type { Capture, CaptureFile } from "./capture.ts";
import { readSafetensors } from "./safetensors.ts";
import { ALL, putDetected, putStructures, type OpenTake } from "./take.ts";
import type { Tensor } from "./tensor.ts";

export interface Loader {
  /** Has a frame fetched before others. */
  want(frame: number): void;
  /** Calls a function with the frames that have come, from the first up to the end of them. */
  onPart(listener: (first: number, end: number) => void): () => void;
  onTrouble(listener: (error: Error) => void): void;
  /** Fetches whatever is not there yet. */
  start(): void;
  stop(): void;
  readonly done: boolean;
}

const PART_BYTES = 3_000_000; // of frames that are fetched at a time
const AT_ONCE = 2; // requests for parts
const OVERVIEW_FRAMES = 500; // that are fetched first, if there are many
const AGAIN_MS = 2000; // after a request failed
const FEW_BYTES = 5_000_000; // of a take that is fetched as a whole

/** Returns how many frames make a part, and every which one is fetched first: 0 if none. */
export function partsOf(frames: number, { views, keypoints }: Capture): { size: number; step: number } {
  const bytes = keypoints * (12 + 12 * views) + 110 * views;
  if (frames * bytes <= FEW_BYTES) return { size: frames, step: 0 };
  return { size: Math.max(1, Math.floor(PART_BYTES / bytes)), step: Math.ceil(frames / OVERVIEW_FRAMES) };
}

/** Fetches structures of some frames, as a slice of Python names them. */
export async function structures(fit: string, query: string, slice: string): Promise<Map<string, Tensor>> {
  return readSafetensors(await getReconstruction(fit, `${query}&frames=${slice}`));
}

/** @param query that says in which frame of reference structures are */
export function createLoader(
  take: OpenTake,
  file: CaptureFile,
  fit: string,
  query: string,
  firstFrame: number,
): Loader {
  const { size } = partsOf(take.frames, take);
  const parts = Array.from({ length: Math.ceil(take.frames / size) }, (_, part) => part);
  const waiting = new Set(parts.filter((part) => take.there[part * size] !== ALL));
  const listeners = new Set<(first: number, end: number) => void>();
  let wanted = Math.floor(firstFrame / size);
  let left = waiting.size;
  let stopped = false;
  let complain: (error: Error) => void = () => {};

  /** Takes the next part from those that wait: the one that is wanted, or the first after it. */
  function next(): number | undefined {
    let best: number | undefined;
    const distance = (part: number) => (part - wanted + parts.length) % parts.length;
    for (const part of waiting) if (best === undefined || distance(part) < distance(best)) best = part;
    if (best !== undefined) waiting.delete(best);
    return best;
  }
  async function work(): Promise<void> {
    for (let part = next(); part !== undefined && !stopped; part = next()) {
      const [first, end] = [part * size, Math.min(take.frames, (part + 1) * size)];
      try {
        await loadPart(take, file, fit, query, first, end);
        left--;
        for (const listener of listeners) listener(first, end);
      } catch (error) {
        waiting.add(part);
        complain(error as Error);
        await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
      }
    }
  }
  return {
    want(frame) {
      wanted = Math.floor(frame / size);
    },
    onPart(listener) {
      listeners.add(listener);
      return () => listeners.delete(listener);
    },
    onTrouble(listener) {
      complain = listener;
    },
    start() {
      for (let worker = 0; worker < AT_ONCE; worker++) void work();
    },
    stop() {
      stopped = true;
    },
    get done() {
      return left === 0;
    },
  };
}

/** Fetches all there is of frames from `first` up to `end`. */
async function loadPart(take: OpenTake, file: CaptureFile, fit: string, query: string, first: number, end: number) {
  const [found, detected] = await Promise.all([structures(fit, query, `${first}:${end}`), file.detected(first, end)]);
  putStructures(take, found, first, 1);
  putDetected(take, detected, first);
}
