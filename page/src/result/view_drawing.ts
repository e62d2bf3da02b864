/** Draws what one view shows in a frame: detected keypoints, the structure projected over them. Strokes
 * of a colour are drawn as one path, for each path costs as much as a hundred strokes. */

import { ALL, type Take } from "../data/take.ts";
import { pixelRatio } from "../parts/canvas_size.ts";
import { colourOf, type Theme } from "../parts/theme.ts";
import { OUTLIER } from "../science/errors.ts";
import { pairAt } from "../science/pairs.ts";
import { project } from "../science/projection.ts";
import type { Part } from "./crop.ts";
import type { Joined } from "./show.ts";

export interface ViewDrawing {
  draw(
    context: CanvasRenderingContext2D,
    frame: number,
    theme: Theme,
    part: Part,
    selected: readonly number[],
    picture: CanvasImageSource | null,
    isCorrected: (keypoint: number) => boolean,
  ): void;
  /** Returns where keypoints were drawn last, as they were detected or else as they project: (P, 2) pixels of
   * the page, NaN where they are not. */
  places(): Float32Array;
  /** Returns the pixel of the image that was drawn at a place, which is in pixels of the page. */
  imageAt(x: number, y: number): [number, number];
  /** Returns where a keypoint was drawn, in pixels of the image; null if it was not. */
  imageOf(keypoint: number): [number, number] | null;
}

const DOT = 2.4; // radius, in pixels of the page, as the others
const RING = 6;
const BOX = 5;
const ARM = 3.6;
const SIDES = [-1, 0, 1];

export function createViewDrawing(take: Take, view: number, edges: Joined["edges"]): ViewDrawing {
  const { keypoints, views } = take;
  const projected = new Float32Array(2 * keypoints).fill(NaN); // pixels of the canvas, as the next
  const detected = new Float32Array(2 * keypoints).fill(NaN);
  const kinds = new Int8Array(keypoints);
  const drawn = { left: 0, top: 0, scale: 1 }; // where the image lies on the canvas
  const imageAt = (x: number, y: number): [number, number] => [
    (x * pixelRatio() - drawn.left) / drawn.scale,
    (y * pixelRatio() - drawn.top) / drawn.scale,
  ];
  const places = () => placesIn(detected, projected).map((pixels) => pixels / pixelRatio());

  return {
    draw(context, frame, theme, part, selected, picture, isCorrected) {
      const { canvas } = context;
      const ratio = pixelRatio();
      const scale = Math.min(canvas.width / part.width, canvas.height / part.height);
      const left = (canvas.width - scale * part.width) / 2 - scale * part.x;
      const top = (canvas.height - scale * part.height) / 2 - scale * part.y;
      Object.assign(drawn, { left, top, scale });
      context.clearRect(0, 0, canvas.width, canvas.height);
      drawImage(context, take.imageSizes[view] ?? null, picture, theme, { left, top, scale, ratio });
      const camera = frame * views + view;
      const known = take.there[frame] === ALL;
      project(take.cameras, camera, take.points, frame * keypoints, keypoints, projected);
      for (let at = 0; at < 2 * keypoints; at += 2) {
        const seen = 2 * camera * keypoints + at;
        projected[at] = left + scale * projected[at]!;
        projected[at + 1] = top + scale * projected[at + 1]!;
        detected[at] = known ? left + scale * take.detected[seen]! : NaN;
        detected[at + 1] = top + scale * take.detected[seen + 1]!;
        kinds[at / 2] = isCorrected(at / 2) ? take.sides[at / 2]! : kindOf(take, camera, at / 2);
      }
      context.lineCap = "round";
      drawStructure(context, projected, edges, theme, ratio);
      drawMisses(context, detected, projected, kinds, theme, ratio);
      drawDetected(context, detected, kinds, theme, ratio);
      for (let keypoint = 0; keypoint < keypoints; keypoint++) {
        if (isCorrected(keypoint)) drawBox(context, placesIn(detected, projected), keypoint, theme, ratio);
      }
      for (const keypoint of selected) drawRing(context, placesIn(detected, projected), keypoint, theme, ratio);
    },
    places,
    imageAt,
    imageOf(keypoint) {
      const [x, y] = pairAt(places(), keypoint);
      return Number.isNaN(x) ? null : imageAt(x, y);
    },
  };
}

/** Returns what was detected, and the projection of what was not. */
function placesIn(detected: Float32Array, projected: Float32Array): Float32Array {
  return detected.map((pixels, at) => (Number.isNaN(pixels) ? projected[at]! : pixels));
}

const CROSSED = 2;

/** Returns the side of an observed keypoint, CROSSED of an outlier. */
function kindOf({ keypoints, outlierProbability, sides }: Take, camera: number, keypoint: number): number {
  return outlierProbability[camera * keypoints + keypoint]! > OUTLIER ? CROSSED : sides[keypoint]!;
}

interface Place {
  left: number;
  top: number;
  scale: number;
  ratio: number;
}

/** Draws the picture of a view or, without one, the edge of its image. */
function drawImage(
  context: CanvasRenderingContext2D,
  imageSize: [number, number] | null,
  picture: CanvasImageSource | null,
  theme: Theme,
  { left, top, scale, ratio }: Place,
): void {
  if (picture !== null) {
    const [width, height] = imageSize ?? sizeOf(picture);
    context.drawImage(picture, left, top, scale * width, scale * height);
  } else if (imageSize !== null) {
    context.strokeStyle = theme.line;
    context.lineWidth = ratio;
    context.strokeRect(left, top, scale * imageSize[0], scale * imageSize[1]);
  }
}

function drawStructure(
  context: CanvasRenderingContext2D,
  pixels: Float32Array,
  edges: Joined["edges"],
  theme: Theme,
  ratio: number,
): void {
  context.beginPath();
  for (const [a, b] of edges) {
    if (Number.isNaN(pixels[2 * a]! + pixels[2 * b]!)) continue;
    context.moveTo(pixels[2 * a]!, pixels[2 * a + 1]!);
    context.lineTo(pixels[2 * b]!, pixels[2 * b + 1]!);
  }
  if (edges.length === 0) {
    for (let at = 0; at < pixels.length; at += 2) {
      if (Number.isNaN(pixels[at])) continue;
      context.moveTo(pixels[at]! + 4 * ratio, pixels[at + 1]!);
      context.arc(pixels[at]!, pixels[at + 1]!, 4 * ratio, 0, 7);
    }
  }
  context.strokeStyle = theme.projected;
  context.lineWidth = 1.6 * ratio;
  context.stroke();
}

/** Draws how far keypoints are from where the structure projects to. */
function drawMisses(
  context: CanvasRenderingContext2D,
  detected: Float32Array,
  projected: Float32Array,
  kinds: Int8Array,
  theme: Theme,
  ratio: number,
): void {
  context.lineWidth = 1.2 * ratio;
  for (const crossed of [false, true]) {
    context.beginPath();
    for (let at = 0; at < detected.length; at += 2) {
      if ((kinds[at / 2] === CROSSED) !== crossed || Number.isNaN(detected[at]! + projected[at]!)) continue;
      context.moveTo(detected[at]!, detected[at + 1]!);
      context.lineTo(projected[at]!, projected[at + 1]!);
    }
    context.strokeStyle = crossed ? theme.outlier : theme.bad;
    context.stroke();
  }
}

function drawDetected(
  context: CanvasRenderingContext2D,
  detected: Float32Array,
  kinds: Int8Array,
  theme: Theme,
  ratio: number,
): void {
  for (const side of SIDES) {
    context.beginPath();
    for (let at = 0; at < detected.length; at += 2) {
      if (kinds[at / 2] !== side || Number.isNaN(detected[at])) continue;
      context.moveTo(detected[at]! + DOT * ratio, detected[at + 1]!);
      context.arc(detected[at]!, detected[at + 1]!, DOT * ratio, 0, 7);
    }
    context.fillStyle = colourOf(theme, side);
    context.fill();
  }
  const arm = ARM * ratio;
  context.beginPath();
  for (let at = 0; at < detected.length; at += 2) {
    const [x, y] = [detected[at]!, detected[at + 1]!];
    if (kinds[at / 2] !== CROSSED || Number.isNaN(x)) continue;
    context.moveTo(x - arm, y - arm);
    context.lineTo(x + arm, y + arm);
    context.moveTo(x - arm, y + arm);
    context.lineTo(x + arm, y - arm);
  }
  context.strokeStyle = theme.outlier;
  context.lineWidth = 2 * ratio;
  context.stroke();
}

function drawRing(
  context: CanvasRenderingContext2D,
  places: Float32Array,
  keypoint: number,
  theme: Theme,
  ratio: number,
): void {
  const [x, y] = pairAt(places, keypoint);
  if (Number.isNaN(x)) return;
  context.beginPath();
  context.arc(x, y, RING * ratio, 0, 7);
  context.strokeStyle = theme.accent;
  context.lineWidth = 2 * ratio;
  context.stroke();
}

/** Draws a box about a keypoint that was corrected; of one that was removed, about where it projects to. */
function drawBox(
  context: CanvasRenderingContext2D,
  places: Float32Array,
  keypoint: number,
  theme: Theme,
  ratio: number,
): void {
  const [x, y] = pairAt(places, keypoint);
  if (Number.isNaN(x)) return;
  const side = 2 * BOX * ratio;
  context.strokeStyle = theme.text;
  context.lineWidth = 1.4 * ratio;
  context.strokeRect(x - side / 2, y - side / 2, side, side);
}

function sizeOf(picture: CanvasImageSource): [number, number] {
  if (picture instanceof HTMLVideoElement) return [picture.videoWidth, picture.videoHeight];
  if (picture instanceof HTMLImageElement) return [picture.naturalWidth, picture.naturalHeight];
  const sized = picture as HTMLCanvasElement;
  return [sized.width, sized.height];
}
