/** The canvas of the 3D view and what draws on it. To start WebGL and to compile its programs takes
 * half a second, in which the browser fetches the structures. */

import { PerspectiveCamera, WebGLRenderer } from "three";
import { readTheme } from "../../parts/theme.ts";
import { resize } from "../../parts/canvas_size.ts";
import { emptyTake, type Take } from "../../data/take.ts";
import { createParts } from "./parts.ts";

let prepared: WebGLRenderer | null = null;

/** Makes ready what the next call of `takeRenderer` returns.
 *
 * @param place whose size the canvas will have: another size later would wait for all that was asked of
 * the graphics card until then */
export function prepareRenderer(place: HTMLElement): void {
  if (prepared !== null) return;
  try {
    prepared = makeRenderer();
    fill(prepared.domElement, place);
    drawOnce(prepared);
  } catch {
    prepared = null; // whoever takes one will be shown why
  }
}

/** Returns a renderer of its own canvas. Throws where the browser has no WebGL. */
export function takeRenderer(): WebGLRenderer {
  const renderer = prepared ?? makeRenderer();
  prepared = null;
  return renderer;
}

/** Makes a canvas as large as what it lies in. */
function fill(canvas: HTMLCanvasElement, place: HTMLElement): void {
  resize(canvas, place.clientWidth, place.clientHeight);
}

function makeRenderer(): WebGLRenderer {
  const renderer = new WebGLRenderer({ antialias: true, alpha: true, preserveDrawingBuffer: true });
  renderer.debug.checkShaderErrors = false; // which waits for each program
  return renderer;
}

/** Draws a structure of two points, so that the programs are compiled. */
function drawOnce(renderer: WebGLRenderer): void {
  const parts = createParts(smallest(), { box: { low: [0, 0, 0], high: [1, 1, 1] }, size: 1 });
  const theme = readTheme();
  parts.skeleton.paint(theme, []);
  parts.trails.paint(theme, [0]);
  renderer.setViewport(0, 0, 2, 2);
  renderer.render(parts.scene, new PerspectiveCamera());
}

function smallest(): Take {
  const capture = { frames: 1, views: 1, keypoints: 2, names: ["a", "b"], viewNames: ["a"], fps: null, times: null };
  const take = emptyTake(
    { ...capture, sides: [0, 0], edges: [[0, 1]], imageSizes: [null], hasTruth: false },
    1,
    "level",
  );
  take.points.fill(0).fill(1, 3);
  return take;
}
