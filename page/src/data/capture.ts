/** What the cameras of a dataset saw, read from its npz file some frames at a time. */

import type { Numbers } from "../science/numbers.ts";
import { pairAt, pairsOf } from "../science/pairs.ts";
import { sidesOf, type Side } from "../science/sides.ts";
import { membersOf, readMembers, type Member, type Npz, type Read } from "./npz.ts";
import { floats, type Tensor } from "./tensor.ts";

export interface Capture {
  readonly frames: number;
  readonly views: number;
  readonly keypoints: number;
  readonly names: readonly string[];
  readonly sides: readonly Side[];
  readonly edges: readonly [number, number][];
  readonly viewNames: readonly string[];
  readonly imageSizes: readonly ([number, number] | null)[];
  readonly fps: number | null;
  readonly times: Numbers | null; // (N,) seconds
  readonly hasTruth: boolean;
}

export interface CaptureFile {
  capture: Capture;
  /** Returns what was detected in frames from `first` up to `end`: (n, K, P, 2) pixels, NaN where
   * nothing was observed. */
  detected(first: number, end: number): Promise<Float32Array>;
  /** Returns the ground truth (N, P, 3). */
  truth(): Promise<Float32Array>;
}

const DESCRIPTION = ["keypoint_names", "edges", "image_sizes", "view_names", "fps", "times"];

/** @param size of the file, in bytes */
export async function openCapture(read: Read, size: number): Promise<CaptureFile> {
  const members = await membersOf(read, size);
  const keypoints = members.get("keypoints");
  if (keypoints === undefined) throw new Error("The capture has no keypoints.");
  const description = DESCRIPTION.flatMap((name) => members.get(name) ?? []);
  const capture = described(keypoints, await readMembers(read, description), members.has("points3d"));
  return {
    capture,
    detected: (first, end) => frames(read, keypoints, first, end),
    async truth() {
      const member = members.get("points3d");
      if (member === undefined) throw new Error("The capture has no ground truth.");
      return frames(read, member, 0, capture.frames);
    },
  };
}

async function frames(read: Read, { kind, start, shape }: Member, first: number, end: number) {
  if (kind !== "f4") throw new Error(`Numbers of kind ${kind} cannot be read here.`);
  const size = 4 * shape.slice(1).reduce((product, side) => product * side, 1);
  return new Float32Array(await read(start + first * size, start + end * size));
}

function described({ shape }: Member, { arrays, texts }: Npz, hasTruth: boolean): Capture {
  const [count, views, keypoints] = shape;
  if (count === undefined || views === undefined || keypoints === undefined) {
    throw new Error("The capture's keypoints are no array (frames, views, keypoints, 2).");
  }
  const names = texts.get("keypoint_names") ?? numbered("keypoint", keypoints);
  const sizes = floats(arrays, "image_sizes");
  const edges = floats(arrays, "edges") ?? new Float32Array();
  return {
    frames: count,
    views,
    keypoints,
    names,
    sides: sidesOf(names),
    edges: pairsOf(edges),
    viewNames: texts.get("view_names") ?? numbered("view", views),
    imageSizes: Array.from({ length: views }, (_, view) =>
      sizes !== undefined && sizes[2 * view]! > 0 ? pairAt(sizes, view) : null,
    ),
    fps: floats(arrays, "fps")?.[0] ?? null,
    times: firstViewsTimes(arrays.get("times"), count),
    hasTruth,
  };
}

/** Returns frames per second, and whether they are known or merely usual. */
export function rateOf({ fps, times }: Capture): { rate: number; known: boolean } {
  if (fps !== null) return { rate: fps, known: true };
  if (times !== null && times.length > 1) {
    const span = times[times.length - 1]! - times[0]!;
    if (span > 0) return { rate: (times.length - 1) / span, known: true };
  }
  return { rate: 30, known: false };
}

/** Returns when frames were captured: (N,) seconds; null if neither times nor fps are known. */
export function secondsOf({ frames, fps, times }: Capture): Float64Array | null {
  if (times !== null) return Float64Array.from(times.subarray(0, frames));
  return fps === null ? null : Float64Array.from({ length: frames }, (_, frame) => frame / fps);
}

export function numbered(word: string, count: number): string[] {
  return Array.from({ length: count }, (_, index) => `${word} ${index}`);
}

function firstViewsTimes(times: Tensor | undefined, frames: number): Float64Array | null {
  if (times === undefined) return null;
  const views = times.shape[1] ?? 1;
  return Float64Array.from({ length: frames }, (_, frame) => times.data[frame * views]!);
}
