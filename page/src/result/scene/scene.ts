/** The structure in its room, in three dimensions. */

import { DirectionalLight, HemisphereLight, Scene, WebGLRenderer } from "three";
import type { Take } from "../../data/take.ts";
import { keepSize, pixelRatio } from "../../parts/canvas_size.ts";
import type { Theme } from "../../parts/theme.ts";
import { boxOf, subjectSize, usualStep, type Box } from "../../science/extent.ts";
import { createFloor } from "./floor.ts";
import { createFrusta } from "./frusta.ts";
import { createSkeleton } from "./skeleton.ts";
import { createTrails, endsOf } from "./trails.ts";
import { createEyes, type Viewpoint } from "./viewpoint.ts";

const FLOWING = 12; // a step of frames that follow each other is less than this part of the subject

export interface Stage extends Viewpoint {
  canvas: HTMLCanvasElement;
  square: number; // side of a square of the floor, in the unit of the points
  flows: boolean; // whether frames follow each other so closely that trails say something
  /** Draws a frame if it, the angle or anything else has changed since the last time. */
  draw(frame: number): void;
  paint(theme: Theme, selected: number | null): void;
  showTrails(shown: boolean): void;
  /** Lays other points (N, P, 3) over the structure, or takes them away. */
  overlay(points: Float32Array | null): void;
  close(): void;
}

/** Starts drawing on a canvas. Throws where the browser has no WebGL. */
export function createStage(canvas: HTMLCanvasElement, take: Take, firstFrame: number): Stage {
  const renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
  const extent = { box: boxOf(take.points, take.keypoints), size: subjectSize(take.points, take.keypoints) };
  const { scene, skeleton, ghost, trails, floor, frusta } = createParts(take, extent);
  let others: Float32Array | null = null;
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
    flows: usualStep(take.points, take.keypoints) < extent.size / FLOWING,
    draw(frame) {
      if (!stale && frame === drawn) return;
      skeleton.show(frame, take.points);
      if (others !== null) ghost.show(frame, others);
      trails.show(frame);
      frusta.show(frame);
      frusta.group.visible = eyes.through() === null;
      renderer.render(scene, eyes.seeing(frame));
      stale = false;
      drawn = frame;
    },
    paint(theme, selected) {
      skeleton.paint(theme, selected);
      ghost.paint(theme, selected);
      trails.paint(theme, selected === null ? endsOf(take) : [selected]);
      floor.paint(theme);
      frusta.paint(theme);
      spoil();
    },
    showTrails(shown) {
      trails.lines.visible = shown;
      spoil();
    },
    overlay(points) {
      others = points;
      ghost.group.visible = points !== null;
      spoil();
    },
    close() {
      stopFitting();
      eyes.close();
      renderer.dispose();
      renderer.forceContextLoss();
    },
  };
}

/** Returns all that is drawn, in sizes that suit the subject's. */
function createParts(take: Take, { box, size }: { box: Box; size: number }) {
  const onFloor = take.frame === "level" && Math.abs(box.low[1]) < 0.2 * size;
  const parts = {
    skeleton: createSkeleton(take, size / 70),
    ghost: createSkeleton(take, size / 52, true),
    trails: createTrails(take, size / 2),
    floor: createFloor(box, size, onFloor ? 0 : box.low[1]),
    frusta: createFrusta(take, size / 3.2),
  };
  parts.ghost.group.visible = false;
  const light = new DirectionalLight(0xffffff, 1.6);
  light.position.set(1, 3, 2);
  const scene = new Scene();
  scene.add(parts.skeleton.group, parts.ghost.group, parts.trails.lines, parts.floor.lines);
  scene.add(parts.frusta.group, light, new HemisphereLight(0xffffff, 0x9aa0a8, 2.1));
  return { scene, ...parts };
}

/** Keeps the drawing as large as its canvas is shown; calls a function after a change. */
function keepFitting(renderer: WebGLRenderer, canvas: HTMLCanvasElement, onSize: () => void): () => void {
  const fit = () => {
    renderer.setViewport(0, 0, canvas.width, canvas.height);
    onSize();
  };
  canvas.width = Math.max(1, Math.round(canvas.clientWidth * pixelRatio()));
  canvas.height = Math.max(1, Math.round(canvas.clientHeight * pixelRatio()));
  fit();
  return keepSize(canvas, fit);
}
