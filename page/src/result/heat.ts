/** Colours of errors, and the two drawings that have a column for each frame: band and heat map. */

import type { Theme } from "../parts/theme.ts";
import { LEFT_OUT, UNSEEN } from "../science/errors.ts";
import type { Numbers } from "../science/numbers.ts";

type Rgb = [number, number, number];

/** From no error to a large one: lightness alone distinguishes them, whatever colours one sees. */
const LIGHT: Rgb[] = [
  [240, 243, 246],
  [247, 234, 217],
  [250, 202, 142],
  [238, 132, 62],
  [196, 52, 36],
  [112, 12, 30],
];
const DARK: Rgb[] = [
  [33, 38, 45],
  [52, 46, 48],
  [104, 56, 46],
  [178, 76, 44],
  [240, 140, 58],
  [255, 232, 140],
];

export function isDark(): boolean {
  return matchMedia("(prefers-color-scheme: dark)").matches;
}

/** Returns 256 colours as numbers of a canvas's pixels (ABGR). */
export function heatColours(dark: boolean): Uint32Array {
  const stops = dark ? DARK : LIGHT;
  return Uint32Array.from({ length: 256 }, (_, index) => {
    const place = (index / 255) * (stops.length - 1);
    const low = Math.min(stops.length - 2, Math.floor(place));
    const share = place - low;
    const [from, to] = [stops[low]!, stops[low + 1]!];
    const mixed = (channel: 0 | 1 | 2) => Math.round(from[channel] * (1 - share) + to[channel] * share);
    return pixel(mixed(0), mixed(1), mixed(2));
  });
}

function pixel(r: number, g: number, b: number): number {
  return ((255 << 24) | (b << 16) | (g << 8) | r) >>> 0;
}

function pixelOf(colour: string): number {
  const channel = (at: number) => parseInt(colour.slice(at, at + 2), 16);
  return pixel(channel(1), channel(3), channel(5));
}

/** Draws numbers (N, P), keypoint x frame, on a canvas that is `width` wide and a pixel high a keypoint: errors, or how
 * far points may be off. A column of several frames shows the largest of them. */
export function drawHeatMap(
  canvas: HTMLCanvasElement,
  values: Numbers,
  keypoints: number,
  width: number,
  largest: number,
  theme: Theme,
  colours: Uint32Array,
): void {
  const frames = values.length / keypoints;
  canvas.width = width;
  canvas.height = keypoints;
  const context = canvas.getContext("2d");
  if (context === null) return;
  const image = context.createImageData(width, keypoints);
  const pixels = new Uint32Array(image.data.buffer);
  const unseen = pixelOf(theme.ground);
  const outlier = pixelOf(theme.outlier);
  for (let column = 0; column < width; column++) {
    const from = Math.floor((column * frames) / width);
    const to = Math.max(from + 1, Math.floor(((column + 1) * frames) / width));
    for (let keypoint = 0; keypoint < keypoints; keypoint++) {
      let worst = UNSEEN;
      let leftOut = false;
      for (let frame = from; frame < to; frame++) {
        const value = values[frame * keypoints + keypoint]!;
        if (value === LEFT_OUT) leftOut = true;
        else if (value > worst) worst = value; // false for NaN
      }
      const level = Math.min(255, Math.floor((255 * worst) / largest));
      const known = worst === UNSEEN ? unseen : colours[level]!;
      pixels[keypoint * width + column] = leftOut ? outlier : known;
    }
  }
  context.putImageData(image, 0, 0);
}

/** Draws the mean error of each frame as a band; frames without an answer are left empty. */
export function drawBand(canvas: HTMLCanvasElement, means: Float32Array, largest: number, colours: Uint32Array): void {
  const context = canvas.getContext("2d");
  if (context === null) return;
  const { width, height } = canvas;
  context.clearRect(0, 0, width, height);
  for (let column = 0; column < width; column++) {
    const from = Math.floor((column * means.length) / width);
    const to = Math.max(from + 1, Math.floor(((column + 1) * means.length) / width));
    let worst = -1;
    for (let frame = from; frame < to; frame++) if (means[frame]! > worst) worst = means[frame]!;
    if (worst < 0) continue;
    const share = Math.min(1, worst / largest);
    const colour = colours[Math.floor(255 * (0.25 + 0.75 * share))]!;
    context.fillStyle = `rgb(${colour & 255} ${(colour >> 8) & 255} ${(colour >> 16) & 255})`;
    const tall = Math.max(2, share * height);
    context.fillRect(column, height - tall, 1, tall);
  }
}
