/** From where the scene is seen: around the subject, along with it, or through a view's camera. */

import { type Matrix4, PerspectiveCamera, Vector3 } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import type { Take } from "../../data/take.ts";
import { pixelRatio } from "../../parts/canvas_size.ts";
import type { Box } from "../../science/extent.ts";
import { boxAbout, follow, middleOf, walks } from "./following.ts";
import { angleOf, boxWithCameras, frameBox, lookThrough, setAngle, turn, type Angle } from "./looking.ts";

export type PoseOf = (frame: number, view: number) => Matrix4 | null;

export interface Viewpoint {
  walks: boolean; // whether the subject walks so far that following it shows more
  /** Goes along with the subject, or stays. */
  follow(following: boolean): void;
  lookThrough(view: number | null): void;
  frameSubject(): void;
  frameCameras(): void;
  angle(): Angle;
  setAngle(angle: Angle): void;
  orbit(right: number, up: number): void;
  /** Where each camera is on the canvas, in CSS pixels; null if it is not on it. */
  cameraPlaces(): ({ x: number; y: number } | null)[];
  onLeaveCamera(listener: () => void): void;
}

export interface Eyes {
  viewpoint: Viewpoint;
  /** Returns what sees a frame that is about to be drawn. */
  seeing(frame: number): PerspectiveCamera;
  through(): number | null;
  /** Follows a change of the canvas's size. */
  fit(): void;
  close(): void;
}

/** @param size of the subject; @param box where it goes; @param onChange called when the scene is
 * seen from elsewhere */
export function createEyes(
  canvas: HTMLCanvasElement,
  take: Take,
  poseOf: PoseOf,
  { box, size }: { box: Box; size: number },
  firstFrame: number,
  onChange: () => void,
): Eyes {
  const viewer = new PerspectiveCamera(38, 1, size / 50, size * 400);
  const eye = new PerspectiveCamera(38, 1, size / 50, size * 400); // in the place of a view's camera
  const controls = new OrbitControls(viewer, canvas);
  controls.zoomSpeed = 1.4;
  let through: number | null = null;
  let following = walks(box, size);
  let middle: Vector3 | null = null; // of the subject, when it was last looked at
  let seen = firstFrame;
  let leave = () => {};
  let held = false; // by a pointer, that may turn it
  controls.addEventListener("start", () => {
    held = true;
  });
  controls.addEventListener("end", () => {
    held = false;
  });
  controls.addEventListener("change", () => {
    onChange();
    if (through === null || !held) return;
    viewpoint.lookThrough(null);
    leave();
  });
  /** Returns a function that does something and has the scene drawn again. */
  const changing =
    <Words extends unknown[]>(act: (...words: Words) => void) =>
    (...words: Words) => {
      act(...words);
      onChange();
    };

  const viewpoint: Viewpoint = {
    walks: following,
    follow(along) {
      following = along;
      middle = null;
    },
    lookThrough: changing((view: number | null) => {
      through = view;
    }),
    frameSubject: changing(() => {
      middle = following ? middleOf(take, seen) : null;
      frameBox(viewer, controls, middle === null ? box : boxAbout(middle, 0.9 * size));
    }),
    frameCameras: changing(() => frameBox(viewer, controls, boxWithCameras(box, take, poseOf))),
    angle: () => angleOf(viewer, controls),
    setAngle: changing((angle: Angle) => setAngle(viewer, controls, angle)),
    orbit: changing((right: number, up: number) => turn(viewer, controls, right, up)),
    cameraPlaces: () =>
      Array.from({ length: take.views }, (_, view) => {
        const pose = through === null ? poseOf(seen, view) : null;
        return pose === null ? null : placeOf(new Vector3().setFromMatrixPosition(pose), viewer, canvas);
      }),
    onLeaveCamera(listener) {
      leave = listener;
    },
  };
  return {
    viewpoint,
    seeing(frame) {
      const pose = through === null ? null : poseOf(frame, through);
      if (following && through === null) {
        const now = middleOf(take, frame);
        if (now !== null && middle !== null && frame !== seen) follow(viewer, controls, middle, now);
        middle = now ?? middle;
      }
      seen = frame;
      if (pose === null || through === null) return viewer;
      lookThrough(eye, pose, take, frame, through, [canvas.width, canvas.height]);
      return eye;
    },
    through: () => through,
    fit() {
      viewer.aspect = canvas.width / canvas.height;
      viewer.updateProjectionMatrix();
    },
    close: () => controls.dispose(),
  };
}

function placeOf(point: Vector3, viewer: PerspectiveCamera, canvas: HTMLCanvasElement) {
  const seen = point.project(viewer);
  if (seen.z > 1 || Math.abs(seen.x) > 1 || Math.abs(seen.y) > 1) return null;
  const [width, height] = [canvas.width / pixelRatio(), canvas.height / pixelRatio()];
  return { x: ((seen.x + 1) / 2) * width, y: ((1 - seen.y) / 2) * height };
}
