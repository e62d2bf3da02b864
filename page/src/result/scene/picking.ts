/** Keypoints under the pointer: their names as it passes over them, and which of them is clicked. */

import { Matrix4, type PerspectiveCamera, Vector3 } from "three";
import type { Numbers } from "../../science/numbers.ts";

export const REACH = 12; // pixels of the page around a keypoint that count as it,
export const TOUCHED = 24; // and around one that a finger points to
export const STILL = 5; // pixels that a pointer may move in a click

export interface Picking {
  names: readonly string[];
  /** Returns where keypoints are on the canvas: (P, 2) pixels of the page, NaN where they are not. */
  places(): ArrayLike<number>;
  /** Is called with a keypoint that was clicked, and whether it is to be added to others: with Shift, and
   * wherever a finger has no Shift. */
  onPick(keypoint: number, adding: boolean): void;
}

/** Returns the keypoint nearest to a place, no farther than `reach` away; null without one. */
export function nearestKeypoint(places: ArrayLike<number>, x: number, y: number, reach: number): number | null {
  let nearest: number | null = null;
  let least = reach;
  for (let keypoint = 0; 2 * keypoint < places.length; keypoint++) {
    const away = Math.hypot(places[2 * keypoint]! - x, places[2 * keypoint + 1]! - y);
    if (away <= least) [nearest, least] = [keypoint, away]; // false for NaN
  }
  return nearest;
}

/** Has keypoints of a canvas named and clicked, until what it returns is called. The canvas lies in an
 * element that has a place (`position`), which gets the name. */
export function pickOn(canvas: HTMLCanvasElement, { names, places, onPick }: Picking): () => void {
  const tip = document.createElement("span");
  tip.className = "name-tip";
  tip.hidden = true;
  tip.setAttribute("aria-hidden", "true"); // who sees no pointer has the list of keypoints
  canvas.after(tip);
  const ending = new AbortController();
  let pressed: { x: number; y: number; keypoint: number } | null = null;
  const under = (event: PointerEvent) =>
    nearestKeypoint(places(), event.offsetX, event.offsetY, event.pointerType === "touch" ? TOUCHED : REACH);
  const name = (keypoint: number | null, event: PointerEvent) => {
    canvas.classList.toggle("pointing", keypoint !== null);
    tip.hidden = keypoint === null;
    if (keypoint === null) return;
    tip.textContent = names[keypoint] ?? "";
    const [x, y] = [canvas.offsetLeft + event.offsetX, canvas.offsetTop + event.offsetY];
    const left = event.offsetX > canvas.clientWidth / 2; // so that it stays inside
    tip.style.transform = `translate(${x + (left ? -10 : 10)}px, ${y - 26}px) translateX(${left ? -100 : 0}%)`;
  };
  // In the capture phase: before anybody who turns the scene hears of it.
  const options = { signal: ending.signal, capture: true };
  canvas.addEventListener("pointermove", (event) => name(event.buttons === 0 ? under(event) : null, event), options);
  canvas.addEventListener("pointerleave", (event) => name(null, event), options);
  canvas.addEventListener(
    "pointerdown",
    (event) => {
      const keypoint = event.button === 0 ? under(event) : null;
      pressed = keypoint === null ? null : { x: event.clientX, y: event.clientY, keypoint };
    },
    options,
  );
  canvas.addEventListener(
    "pointerup",
    (event) => {
      if (pressed === null) return;
      const { x, y, keypoint } = pressed;
      pressed = null;
      if (Math.hypot(event.clientX - x, event.clientY - y) > STILL) return;
      onPick(keypoint, event.shiftKey || event.pointerType === "touch");
    },
    options,
  );
  return () => {
    ending.abort();
    canvas.classList.remove("pointing");
    tip.remove();
  };
}

/** Returns where points of a frame are on a canvas of `width` x `height`: (P, 2), NaN behind the viewer.
 *
 * @param first of the frame's points (P, 3), in numbers */
export function placesOf(
  points: Numbers,
  first: number,
  keypoints: number,
  viewer: PerspectiveCamera,
  [width, height]: [number, number],
): Float32Array {
  viewer.updateMatrixWorld();
  const seen = new Matrix4().multiplyMatrices(viewer.projectionMatrix, viewer.matrixWorldInverse);
  const places = new Float32Array(2 * keypoints).fill(NaN);
  const point = new Vector3();
  for (let keypoint = 0; keypoint < keypoints; keypoint++) {
    point.fromArray(points, first + 3 * keypoint).applyMatrix4(seen);
    if (!(point.z < 1)) continue; // behind, or NaN
    places[2 * keypoint] = ((point.x + 1) / 2) * width;
    places[2 * keypoint + 1] = ((1 - point.y) / 2) * height;
  }
  return places;
}
