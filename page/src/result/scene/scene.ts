/** The structure in its room, in three dimensions. */

import {
  DirectionalLight,
  HemisphereLight,
  PerspectiveCamera,
  Scene,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import type { Take } from "../../data/take.ts";
import { keepSize, pixelRatio } from "../../parts/canvas_size.ts";
import type { Theme } from "../../parts/theme.ts";
import { boxOf, subjectSize, usualStep, type Box } from "../../science/extent.ts";
import { createFloor } from "./floor.ts";
import { boxAbout, follow, middleOf, walks } from "./following.ts";
import { createFrusta } from "./frusta.ts";
import { angleOf, frameBox, lookThrough, setAngle, type Angle } from "./looking.ts";
import { createSkeleton } from "./skeleton.ts";
import { createTrails, endsOf } from "./trails.ts";

const FLOWING = 12; // a step of frames that follow each other is less than this part of the subject

export interface Stage {
  square: number; // side of a square of the floor, in the unit of the points
  canvas: HTMLCanvasElement;
  /** Draws a frame if it, the angle or anything else has changed since the last time. */
  draw(frame: number): void;
  paint(theme: Theme, selected: number | null): void;
  flows: boolean; // whether frames follow each other so closely that trails say something
  walks: boolean; // whether the subject walks so far that following it shows more
  /** Goes along with the subject, or stays. */
  follow(following: boolean): void;
  showTrails(shown: boolean): void;
  /** Lays other points (N, P, 3) over the structure, or takes them away. */
  overlay(points: Float32Array | null): void;
  lookThrough(view: number | null): void;
  frameSubject(): void;
  frameCameras(): void;
  angle(): Angle;
  setAngle(angle: Angle): void;
  orbit(right: number, up: number): void;
  /** Where each camera is on the canvas, in CSS pixels; null if it is not on it. */
  cameraPlaces(): ({ x: number; y: number } | null)[];
  onLeaveCamera(listener: () => void): void;
  close(): void;
}

/** Starts drawing on a canvas. Throws where the browser has no WebGL. */
export function createStage(canvas: HTMLCanvasElement, take: Take, firstFrame: number): Stage {
  const renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
  const scene = new Scene();
  const viewer = new PerspectiveCamera(38, 1, 0.01, 100);
  const eye = new PerspectiveCamera(); // in the place of a view's camera
  const controls = new OrbitControls(viewer, canvas);
  controls.enableDamping = false;
  controls.zoomSpeed = 1.4;
  const box = boxOf(take.points, take.keypoints);
  const size = subjectSize(take.points, take.keypoints);
  viewer.near = eye.near = size / 50;
  viewer.far = eye.far = size * 400;
  const level = take.frame === "level" && box.low[1] > -0.2 * size && box.low[1] < 0.2 * size ? 0 : box.low[1];
  const parts = {
    skeleton: createSkeleton(take, size / 70),
    ghost: createSkeleton(take, size / 52, true),
    trails: createTrails(take, size / 2),
    floor: createFloor(box, size, level),
    frusta: createFrusta(take, size / 3.2),
  };
  parts.ghost.group.visible = false;
  scene.add(parts.skeleton.group, parts.ghost.group, parts.trails.lines, parts.floor.lines, parts.frusta.group);
  addLights(scene);

  let through: number | null = null;
  let others: Float32Array | null = null;
  let stale = true;
  let following = walks(box, size);
  let middle: Vector3 | null = null; // of the subject, when it was last looked at
  let drawn = firstFrame;
  let leave = () => {};
  controls.addEventListener("change", () => {
    stale = true;
  });
  controls.addEventListener("start", () => {
    if (through === null) return;
    stage.lookThrough(null);
    leave();
  });

  const stage: Stage = {
    square: parts.floor.square,
    canvas,
    draw(frame) {
      if (!stale && frame === drawn) return;
      if (following && through === null) {
        const now = middleOf(take, frame);
        if (now !== null && middle !== null && frame !== drawn) follow(viewer, controls, middle, now);
        middle = now ?? middle;
      }
      parts.skeleton.show(frame, take.points);
      if (others !== null) parts.ghost.show(frame, others);
      parts.trails.show(frame);
      parts.frusta.show(frame);
      const pose = through === null ? null : parts.frusta.pose(frame, through);
      if (pose !== null && through !== null) {
        lookThrough(eye, pose, take, frame, through, [canvas.width, canvas.height]);
      }
      renderer.render(scene, pose === null ? viewer : eye);
      stale = false;
      drawn = frame;
    },
    paint(theme, selected) {
      parts.skeleton.paint(theme, selected);
      parts.ghost.paint(theme, selected);
      parts.trails.paint(theme, selected === null ? endsOf(take) : [selected]);
      parts.floor.paint(theme);
      parts.frusta.paint(theme, through);
      stale = true;
    },
    flows: usualStep(take.points, take.keypoints) < size / FLOWING,
    walks: following,
    follow(along) {
      following = along;
      middle = null;
    },
    showTrails(shown) {
      parts.trails.lines.visible = shown;
      stale = true;
    },
    overlay(points) {
      others = points;
      parts.ghost.group.visible = points !== null;
      stale = true;
    },
    lookThrough(view) {
      through = view;
      parts.frusta.group.visible = view === null;
      stale = true;
    },
    frameSubject() {
      const about = following ? middleOf(take, drawn) : null;
      frameBox(viewer, controls, about === null ? box : boxAbout(about, 0.9 * size));
      middle = about;
      stale = true;
    },
    frameCameras() {
      frameBox(viewer, controls, around(box, take, parts.frusta.pose));
      stale = true;
    },
    angle: () => angleOf(viewer, controls),
    setAngle(angle) {
      setAngle(viewer, controls, angle);
      stale = true;
    },
    orbit(right, up) {
      turn(viewer, controls, right, up);
      stale = true;
    },
    cameraPlaces() {
      return Array.from({ length: take.views }, (_, view) => {
        const pose = through === null ? parts.frusta.pose(drawn, view) : null;
        return pose === null ? null : placeOf(new Vector3().setFromMatrixPosition(pose), viewer, canvas);
      });
    },
    onLeaveCamera(listener) {
      leave = listener;
    },
    close() {
      stopFitting();
      controls.dispose();
      renderer.dispose();
      renderer.forceContextLoss();
    },
  };
  const stopFitting = keepFitting(renderer, viewer, canvas, () => {
    stale = true;
  });
  stage.frameSubject();
  return stage;
}

function addLights(scene: Scene): void {
  const key = new DirectionalLight(0xffffff, 1.6);
  key.position.set(1, 3, 2);
  scene.add(new HemisphereLight(0xffffff, 0x9aa0a8, 2.1), key);
}

/** Keeps the drawing as large as its canvas is shown; calls a function after a change. */
function keepFitting(
  renderer: WebGLRenderer,
  viewer: PerspectiveCamera,
  canvas: HTMLCanvasElement,
  onSize: () => void,
): () => void {
  const fit = () => {
    renderer.setViewport(0, 0, canvas.width, canvas.height);
    viewer.aspect = canvas.width / canvas.height;
    viewer.updateProjectionMatrix();
    onSize();
  };
  canvas.width = Math.max(1, Math.round(canvas.clientWidth * pixelRatio()));
  canvas.height = Math.max(1, Math.round(canvas.clientHeight * pixelRatio()));
  fit();
  return keepSize(canvas, fit);
}

/** Turns the viewer about the target, by angles in radians. */
function turn(viewer: PerspectiveCamera, controls: OrbitControls, right: number, up: number): void {
  const arm = viewer.position.clone().sub(controls.target);
  arm.applyAxisAngle(new Vector3(0, 1, 0), right);
  const side = new Vector3(0, 1, 0).cross(arm).normalize();
  const raised = arm.clone().applyAxisAngle(side, -up);
  if (Math.abs(raised.clone().normalize().y) < 0.98) arm.copy(raised);
  viewer.position.copy(controls.target).add(arm);
  controls.update();
}

/** Returns the box around the subject and all cameras of the first frame that has them. */
function around(
  box: Box,
  take: Take,
  pose: (frame: number, view: number) => { elements: ArrayLike<number> } | null,
): Box {
  const low = [...box.low] as Box["low"];
  const high = [...box.high] as Box["high"];
  for (let view = 0; view < take.views; view++) {
    for (let frame = 0; frame < take.frames; frame++) {
      const place = pose(frame, view)?.elements;
      if (place === undefined) continue;
      for (let axis = 0; axis < 3; axis++) {
        low[axis] = Math.min(low[axis], place[12 + axis]);
        high[axis] = Math.max(high[axis], place[12 + axis]);
      }
      break;
    }
  }
  return { low, high };
}

function placeOf(point: Vector3, viewer: PerspectiveCamera, canvas: HTMLCanvasElement) {
  const seen = point.project(viewer);
  if (seen.z > 1 || Math.abs(seen.x) > 1 || Math.abs(seen.y) > 1) return null;
  const [width, height] = [canvas.width / pixelRatio(), canvas.height / pixelRatio()];
  return { x: ((seen.x + 1) / 2) * width, y: ((1 - seen.y) / 2) * height };
}
