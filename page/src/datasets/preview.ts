/** Draws the detected keypoints of one frame of a view. */

import type { Dataset } from "../api/resources.ts";
import type { CaptureFile } from "../data/capture.ts";
import { pixelRatio } from "../parts/canvas_size.ts";
import { colourOf, readTheme } from "../parts/theme.ts";
import { pairAt, pairsOf } from "../science/pairs.ts";
import { sidesOf, type Side } from "../science/sides.ts";

const MARGIN = 0.12;
const PLACES = 8; // of a capture that are looked at
const AT_A_PLACE = 12; // frames

/** One frame of all views, and how it is drawn. */
export interface Drawn {
  views: Float32Array[]; // (P, 2) pixels each, NaN where not observed
  edges: readonly [number, number][];
  sides: readonly Side[];
}

export function drawKeypoints(canvas: HTMLCanvasElement, { views, edges, sides }: Drawn, view: number): void {
  const pixels = views[view] ?? new Float32Array();
  const xs = evens(pixels, 0);
  const ys = evens(pixels, 1);
  const context = canvas.getContext("2d");
  if (context === null || xs.length === 0) return;
  const ratio = pixelRatio();
  canvas.width = canvas.clientWidth * ratio;
  canvas.height = canvas.clientHeight * ratio;
  const theme = readTheme();
  const [left, top] = [Math.min(...xs), Math.min(...ys)];
  const [width, height] = [Math.max(...xs) - left || 1, Math.max(...ys) - top || 1];
  const scale = (1 - 2 * MARGIN) * Math.min(canvas.width / width, canvas.height / height);
  const place = ([x, y]: [number, number]): [number, number] => [
    canvas.width / 2 + scale * (x - left - width / 2),
    canvas.height / 2 + scale * (y - top - height / 2),
  ];
  context.strokeStyle = theme.quiet;
  context.lineWidth = 1.5 * ratio;
  context.beginPath();
  for (const [a, b] of edges) {
    const [from, to] = [pairAt(pixels, a), pairAt(pixels, b)];
    if (Number.isNaN(from[0] + to[0])) continue;
    context.moveTo(...place(from));
    context.lineTo(...place(to));
  }
  context.stroke();
  pairsOf(pixels).forEach((pixel, keypoint) => {
    if (Number.isNaN(pixel[0])) return;
    context.beginPath();
    context.arc(...place(pixel), 3 * ratio, 0, 7);
    context.fillStyle = colourOf(theme, sides[keypoint] ?? 0);
    context.fill();
  });
}

/** Returns the frame, of a few from all of a capture, in which most keypoints are observed. */
export async function fullestFrame({ capture, detected }: CaptureFile): Promise<Drawn> {
  const { frames, views, keypoints, edges, sides } = capture;
  const starts = Array.from({ length: PLACES }, (_, place) => Math.floor((place * frames) / PLACES));
  const read = starts.map((start) => detected(start, Math.min(frames, start + AT_A_PLACE)));
  const size = 2 * keypoints;
  let best: Float32Array = new Float32Array();
  let most = -1;
  for (const pixels of await Promise.all(read)) {
    for (let first = 0; first < pixels.length; first += views * size) {
      const frame = pixels.subarray(first, first + views * size);
      const known = frame.reduce((sum, value) => sum + (Number.isNaN(value) ? 0 : 1), 0);
      if (known > most) [best, most] = [frame, known];
    }
  }
  const seen = Array.from({ length: views }, (_, view) => best.subarray(view * size, (view + 1) * size));
  return { views: seen, edges, sides };
}

/** Returns a frame drawn with the skeleton that its dataset has now. */
export function drawnAs(frame: Drawn, { skeleton }: Dataset): Drawn {
  const edges = (skeleton?.edges ?? []) as [number, number][];
  return { ...frame, edges, sides: sidesOf(skeleton?.keypoint_names ?? []) };
}

function evens(pixels: Float32Array, offset: number): number[] {
  return Array.from(pixels).filter((value, at) => at % 2 === offset && !Number.isNaN(value));
}
