/** Dragging keypoints of a view's picture, and moving them with keys. */

import { nearestKeypoint, REACH, STILL, TOUCHED } from "../scene/picking.ts";
import type { Position } from "../../data/corrections.ts";

export interface Handle {
  /** Returns where keypoints are on the canvas: (P, 2) pixels of the page, NaN where they are not. */
  places(): ArrayLike<number>;
  /** Returns the pixel of the view's image at a place on the canvas. */
  imageAt(x: number, y: number): Position;
  selected(): readonly number[];
  /** Is called as a keypoint is taken hold of, and again as it is let go. */
  onHold(keypoint: number | null): void;
  onMove(keypoint: number, position: Position): void;
  onPut(keypoint: number, position: Position): void;
  onGiveUp(keypoint: number): void;
}

/** Has keypoints of a canvas dragged, until what it returns is called. A keypoint that is selected is taken
 * before others that are as near. */
export function dragOn(canvas: HTMLCanvasElement, handle: Handle): () => void {
  const ending = new AbortController();
  const options = { signal: ending.signal };
  let held: { keypoint: number; pointer: number; x: number; y: number; moves: boolean } | null = null;

  const under = (x: number, y: number, touch: boolean): number | null => {
    const places = handle.places();
    const reach = touch ? TOUCHED : REACH;
    const chosen = handle.selected();
    const own = Float32Array.from(places, (pixels, at) => (chosen.includes(at >> 1) ? pixels : NaN));
    return nearestKeypoint(own, x, y, reach) ?? nearestKeypoint(places, x, y, reach);
  };
  const letGo = () => {
    held = null;
    handle.onHold(null);
  };
  canvas.addEventListener(
    "pointerdown",
    (event) => {
      const keypoint = event.button === 0 ? under(event.offsetX, event.offsetY, event.pointerType === "touch") : null;
      if (keypoint === null || held !== null) return;
      held = { keypoint, pointer: event.pointerId, x: event.offsetX, y: event.offsetY, moves: false };
      canvas.setPointerCapture(event.pointerId);
      handle.onHold(keypoint);
    },
    options,
  );
  canvas.addEventListener(
    "pointermove",
    (event) => {
      if (held === null || event.pointerId !== held.pointer) return;
      held.moves ||= Math.hypot(event.offsetX - held.x, event.offsetY - held.y) > STILL;
      if (held.moves) handle.onMove(held.keypoint, handle.imageAt(event.offsetX, event.offsetY));
    },
    options,
  );
  canvas.addEventListener(
    "pointerup",
    (event) => {
      if (held === null || event.pointerId !== held.pointer) return;
      const { keypoint, moves } = held;
      if (moves) handle.onPut(keypoint, handle.imageAt(event.offsetX, event.offsetY));
      letGo();
    },
    options,
  );
  const giveUp = () => {
    if (held === null) return;
    handle.onGiveUp(held.keypoint);
    letGo();
  };
  canvas.addEventListener("pointercancel", giveUp, options);
  window.addEventListener(
    "keydown",
    (event) => {
      if (held === null || event.key !== "Escape") return;
      event.stopPropagation();
      giveUp();
    },
    { ...options, capture: true },
  );
  // A finger on a keypoint moves that; elsewhere it moves the page.
  canvas.addEventListener(
    "touchstart",
    (event) => {
      if (held !== null) event.preventDefault();
    },
    { ...options, passive: false },
  );
  // A click does not give the focus, in which arrows would move keypoints and no frames.
  canvas.addEventListener("mousedown", (event) => event.preventDefault(), options);
  return () => ending.abort();
}

const STEPS: Record<string, Position> = {
  ArrowLeft: [-1, 0],
  ArrowRight: [1, 0],
  ArrowUp: [0, -1],
  ArrowDown: [0, 1],
};

/** Returns how many pixels a key moves the selected keypoint; null if it does not. */
export function stepOf({ key, shiftKey }: KeyboardEvent): Position | null {
  const step = STEPS[key];
  if (step === undefined) return null;
  const far = shiftKey ? 10 : 1;
  return [far * step[0], far * step[1]];
}
