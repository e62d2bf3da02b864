/** The structure in its room, in three dimensions. */

import type { WebGLRenderer } from "three";
import type { Take } from "../../data/take.ts";
import { keepSize, pixelRatio, resize } from "../../parts/canvas_size.ts";
import type { Theme } from "../../parts/theme.ts";
import { boxOf, subjectSize, usualStep } from "../../science/extent.ts";
import type { Numbers } from "../../science/numbers.ts";
import type { Covariances } from "../../science/covariances.ts";
import type { Joined } from "../show.ts";
import { losses } from "./doubt.ts";
import { createParts, type Extent } from "./parts.ts";
import { placesOf } from "./picking.ts";
import { takeRenderer } from "./renderer.ts";
import { endsOf } from "./trails.ts";
import { createEyes, type Viewpoint } from "./viewpoint.ts";

const FLOWING = 12; // a step of frames that follow each other is less than this part of the subject

export interface Stage extends Viewpoint {
  canvas: HTMLCanvasElement;
  square: number; // side of a square of the floor, in the unit of the points
  flows: boolean; // whether frames follow each other so closely that trails say something
  /** Draws a frame if it, the angle or anything else has changed since the last time; returns whether
   * that was so. */
  draw(frame: number): boolean;
  /** Has the next frame drawn again: its points have changed. */
  spoil(): void;
  paint(theme: Theme, selected: readonly number[]): void;
  /** Returns where keypoints of the frame that is drawn are: (P, 2) pixels of the page, NaN where they are
   * not. */
  keypointPlaces(): Float32Array;
  showTrails(shown: boolean): void;
  /** Shows how far points may be off, or not.
   *
   * @param covariances by which hulls get their directions; without them they are spheres */
  showDoubt(shown: boolean, covariances: Covariances | null): void;
  /** Draws other edges than the skeleton's, or these again; to be painted after it. */
  join(joined: Joined | null): void;
  /** Lays other points (N, P, 3) over the structure, or takes them away. */
  overlay(points: Numbers | null): void;
  close(): void;
}

/** Returns how large a subject is and where it goes, as far as its frames are there. */
export function extentOf({ points, keypoints, there }: Take): Extent {
  return { box: boxOf(points, keypoints, there), size: subjectSize(points, keypoints, there) };
}

/** Puts a canvas into an element and starts to draw. Throws where the browser has no WebGL. */
export function createStage(holder: HTMLElement, take: Take, firstFrame: number, extent = extentOf(take)): Stage {
  const renderer = takeRenderer();
  const canvas = renderer.domElement;
  holder.append(canvas);
  const { scene, skeleton, ghost, hulls, trails, floor, frusta } = createParts(take, extent);
  let others: Numbers | null = null;
  let covariances: Covariances | null = null;
  let drawn = -1;
  let stale = true;
  const spoil = () => {
    stale = true;
  };
  const eyes = createEyes(canvas, take, frusta.pose, extent, firstFrame, spoil);
  const stopFitting = keepFitting(renderer, canvas, () => {
    eyes.fit();
    spoil();
  });
  eyes.viewpoint.frameSubject();

  return {
    ...eyes.viewpoint,
    canvas,
    square: floor.square,
    flows: usualStep(take.points, take.keypoints, take.there) < extent.size / FLOWING,
    spoil,
    draw(frame) {
      if (!stale && frame === drawn) return false;
      skeleton.show(frame, take.points, hulls.mesh.visible ? losses(take, frame, extent.size) : undefined);
      if (hulls.mesh.visible) hulls.show(frame, covariances);
      if (others !== null) ghost.show(frame, others);
      trails.show(frame);
      frusta.show(frame);
      frusta.group.visible = eyes.through() === null;
      renderer.render(scene, eyes.seeing(frame));
      stale = false;
      drawn = frame;
      return true;
    },
    paint(theme, selected) {
      skeleton.paint(theme, selected);
      ghost.paint(theme, selected);
      hulls.paint(theme);
      trails.paint(theme, selected.length === 0 ? endsOf(take) : selected);
      floor.paint(theme);
      frusta.paint(theme);
      spoil();
    },
    keypointPlaces() {
      if (drawn < 0) return new Float32Array(); // nothing is there yet
      const size: [number, number] = [canvas.width / pixelRatio(), canvas.height / pixelRatio()];
      return placesOf(take.points, 3 * take.keypoints * drawn, take.keypoints, eyes.seeing(drawn), size);
    },
    showTrails(shown) {
      trails.lines.visible = shown;
      spoil();
    },
    showDoubt(shown, known) {
      hulls.mesh.visible = shown;
      covariances = known;
      spoil();
    },
    join(joined) {
      skeleton.join(joined);
      ghost.join(joined);
    },
    overlay(points) {
      others = points;
      ghost.group.visible = points !== null;
      spoil();
    },
    close() {
      stopFitting();
      eyes.close();
      canvas.remove();
      renderer.dispose();
      renderer.forceContextLoss();
    },
  };
}

/** Keeps the drawing as large as its canvas is shown; calls a function after a change. */
function keepFitting(renderer: WebGLRenderer, canvas: HTMLCanvasElement, onSize: () => void): () => void {
  const fit = () => {
    renderer.setViewport(0, 0, canvas.width, canvas.height);
    onSize();
  };
  resize(canvas, canvas.clientWidth, canvas.clientHeight);
  fit();
  return keepSize(canvas, fit);
}
