/** Draws what one view shows in a frame: detected keypoints, the structure projected over them. */

import type { Take } from "../data/take.ts";
import { pixelRatio } from "../parts/canvas_size.ts";
import { colourOf, type Theme } from "../parts/theme.ts";
import { OUTLIER } from "../science/errors.ts";
import { project } from "../science/projection.ts";
import type { Part } from "./crop.ts";

export interface ViewDrawing {
  draw(
    context: CanvasRenderingContext2D,
    frame: number,
    theme: Theme,
    part: Part,
    selected: number | null,
    picture: CanvasImageSource | null,
  ): void;
}

export function createViewDrawing(take: Take, view: number): ViewDrawing {
  const { keypoints, views, edges, sides, detected, outlierProbability } = take;
  const pixels = new Float32Array(2 * keypoints);

  return {
    draw(context, frame, theme, part, selected, picture) {
      const { canvas } = context;
      const ratio = pixelRatio();
      const scale = Math.min(canvas.width / part.width, canvas.height / part.height);
      const left = (canvas.width - scale * part.width) / 2 - scale * part.x;
      const top = (canvas.height - scale * part.height) / 2 - scale * part.y;
      context.clearRect(0, 0, canvas.width, canvas.height);
      const [width, height] = take.imageSizes[view] ?? [0, 0];
      if (picture !== null) {
        const size = sizeOf(picture);
        const shown = width > 0 ? [width, height] : size;
        context.drawImage(picture, left, top, scale * shown[0], scale * shown[1]);
      } else if (width > 0) {
        context.strokeStyle = theme.line;
        context.lineWidth = ratio;
        context.strokeRect(left, top, scale * width, scale * height);
      }
      const camera = frame * views + view;
      project(take.cameras, camera, take.points, frame * keypoints, keypoints, pixels);
      context.lineCap = "round";
      const on = { context, scale, left, top, ratio };
      drawStructure(on, pixels, edges, theme);
      for (let keypoint = 0; keypoint < keypoints; keypoint++) {
        const seen = camera * keypoints + keypoint;
        const x = left + scale * detected[2 * seen];
        if (Number.isNaN(x)) continue;
        const y = top + scale * detected[2 * seen + 1];
        const outlier = outlierProbability !== undefined && outlierProbability[seen] > OUTLIER;
        drawMiss(on, x, y, pixels, keypoint, outlier ? theme.outlier : theme.bad);
        if (outlier) drawCross(on, x, y, theme.outlier);
        else drawDot(on, x, y, colourOf(theme, sides[keypoint]), keypoint === selected ? theme.accent : null);
      }
    },
  };
}

interface On {
  context: CanvasRenderingContext2D;
  scale: number;
  left: number;
  top: number;
  ratio: number;
}

function drawStructure(on: On, pixels: Float32Array, edges: Take["edges"], theme: Theme): void {
  const { context, scale, left, top, ratio } = on;
  context.beginPath();
  for (const [a, b] of edges) {
    if (Number.isNaN(pixels[2 * a] + pixels[2 * b])) continue;
    context.moveTo(left + scale * pixels[2 * a], top + scale * pixels[2 * a + 1]);
    context.lineTo(left + scale * pixels[2 * b], top + scale * pixels[2 * b + 1]);
  }
  if (edges.length === 0) {
    for (let at = 0; at < pixels.length; at += 2) {
      if (Number.isNaN(pixels[at])) continue;
      const [x, y] = [left + scale * pixels[at], top + scale * pixels[at + 1]];
      context.moveTo(x + 4 * ratio, y);
      context.arc(x, y, 4 * ratio, 0, 7);
    }
  }
  context.strokeStyle = theme.projected;
  context.lineWidth = 1.6 * ratio;
  context.stroke();
}

/** Draws how far a keypoint is from where the structure projects to. */
function drawMiss(on: On, x: number, y: number, pixels: Float32Array, keypoint: number, colour: string): void {
  const { context, scale, left, top, ratio } = on;
  if (Number.isNaN(pixels[2 * keypoint])) return;
  context.beginPath();
  context.moveTo(x, y);
  context.lineTo(left + scale * pixels[2 * keypoint], top + scale * pixels[2 * keypoint + 1]);
  context.strokeStyle = colour;
  context.lineWidth = 1.2 * ratio;
  context.stroke();
}

function drawDot(on: On, x: number, y: number, colour: string, ring: string | null): void {
  const { context, ratio } = on;
  context.beginPath();
  context.arc(x, y, 2.4 * ratio, 0, 7);
  context.fillStyle = colour;
  context.fill();
  if (ring === null) return;
  context.beginPath();
  context.arc(x, y, 6 * ratio, 0, 7);
  context.strokeStyle = ring;
  context.lineWidth = 2 * ratio;
  context.stroke();
}

function drawCross(on: On, x: number, y: number, colour: string): void {
  const { context, ratio } = on;
  const arm = 3.6 * ratio;
  context.beginPath();
  context.moveTo(x - arm, y - arm);
  context.lineTo(x + arm, y + arm);
  context.moveTo(x - arm, y + arm);
  context.lineTo(x + arm, y - arm);
  context.strokeStyle = colour;
  context.lineWidth = 2 * ratio;
  context.stroke();
}

function sizeOf(picture: CanvasImageSource): [number, number] {
  if (picture instanceof HTMLVideoElement) return [picture.videoWidth, picture.videoHeight];
  if (picture instanceof HTMLImageElement) return [picture.naturalWidth, picture.naturalHeight];
  const sized = picture as HTMLCanvasElement;
  return [sized.width, sized.height];
}
