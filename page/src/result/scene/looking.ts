/** Where the viewer stands: around the subject, or in the place of a camera. */

import { type Matrix4, type PerspectiveCamera, Vector3 } from "three";
import type { OrbitControls } from "three/addons/controls/OrbitControls.js";
import type { Take } from "../../data/take.ts";
import type { Box } from "../../science/extent.ts";
import { pairAt } from "../../science/pairs.ts";

/** Position and target, six numbers: what a link keeps. */
export type Angle = number[];

/** Returns a camera's image as a rectangle of a canvas (as large as fits), in pixels of it. */
export function imageIn(size: [number, number], canvas: [number, number]): { x: number; y: number; scale: number } {
  const scale = Math.min(canvas[0] / size[0], canvas[1] / size[1]);
  return { x: (canvas[0] - scale * size[0]) / 2, y: (canvas[1] - scale * size[1]) / 2, scale };
}

/** Puts an eye behind a view's lens, so that points are where its image has them. Distortion is
 * left out: the scene is drawn by a pinhole. */
export function lookThrough(
  eye: PerspectiveCamera,
  pose: Matrix4,
  take: Take,
  frame: number,
  view: number,
  canvas: [number, number],
): void {
  const camera = frame * take.views + view;
  const [fx, fy] = pairAt(take.cameras.focals, camera);
  const [cx, cy] = pairAt(take.cameras.principalPoints, camera);
  const { x, y, scale } = imageIn(take.imageSizes[view] ?? [2 * cx, 2 * cy], canvas);
  eye.matrixAutoUpdate = false; // nobody turns it
  eye.matrix.copy(pose);
  // The scene's camera looks along -z with y up, OpenCV's along z with y down.
  for (const column of [1, 2]) {
    for (let row = 0; row < 3; row++) eye.matrix.elements[4 * column + row]! *= -1;
  }
  eye.matrixWorldNeedsUpdate = true;
  eye.updateMatrixWorld(true);
  const near = eye.near;
  const perPixel = near / scale;
  eye.projectionMatrix.makePerspective(
    ((-x - scale * cx) / fx) * perPixel,
    ((canvas[0] - x - scale * cx) / fx) * perPixel,
    ((y + scale * cy) / fy) * perPixel,
    ((y + scale * cy - canvas[1]) / fy) * perPixel,
    near,
    eye.far,
  );
  eye.projectionMatrixInverse.copy(eye.projectionMatrix).invert();
}

const MARGIN = 1.06; // of the distance that just shows all of a box

/** Places the viewer so that a box just fits into the picture, seen from where he stands or, at
 * first, from a little above and to the side. */
export function frameBox(viewer: PerspectiveCamera, controls: OrbitControls, box: Box): void {
  const middle = new Vector3(...box.low).add(new Vector3(...box.high)).multiplyScalar(0.5);
  const back = viewer.position.clone().sub(controls.target);
  if (back.lengthSq() === 0) back.set(0.55, 0.32, 1);
  back.normalize();
  const right = new Vector3(0, 1, 0).cross(back).normalize();
  const up = back.clone().cross(right);
  const upright = Math.tan((viewer.fov / 360) * Math.PI);
  const level = upright * viewer.aspect;
  let away = 0;
  for (let corner = 0; corner < 8; corner++) {
    const at = new Vector3(
      (corner & 1 ? box.high : box.low)[0],
      (corner & 2 ? box.high : box.low)[1],
      (corner & 4 ? box.high : box.low)[2],
    ).sub(middle);
    const reach = Math.max(Math.abs(at.dot(right)) / level, Math.abs(at.dot(up)) / upright);
    away = Math.max(away, at.dot(back) + reach);
  }
  controls.target.copy(middle);
  viewer.position.copy(middle).addScaledVector(back, MARGIN * away);
  controls.update();
}

export function angleOf(viewer: PerspectiveCamera, controls: OrbitControls): Angle {
  return [...viewer.position.toArray(), ...controls.target.toArray()];
}

export function setAngle(viewer: PerspectiveCamera, controls: OrbitControls, angle: Angle): void {
  viewer.position.fromArray(angle);
  controls.target.fromArray(angle, 3);
  controls.update();
}

/** Turns the viewer about the target, by angles in radians. */
export function turn(viewer: PerspectiveCamera, controls: OrbitControls, right: number, up: number): void {
  const arm = viewer.position.clone().sub(controls.target);
  arm.applyAxisAngle(new Vector3(0, 1, 0), right);
  const side = new Vector3(0, 1, 0).cross(arm).normalize();
  const raised = arm.clone().applyAxisAngle(side, -up);
  if (Math.abs(raised.clone().normalize().y) < 0.98) arm.copy(raised);
  viewer.position.copy(controls.target).add(arm);
  controls.update();
}

/** Returns the box around the subject and each camera, as the first frame that has it shows it. */
export function boxWithCameras(box: Box, take: Take, poseOf: (frame: number, view: number) => Matrix4 | null): Box {
  const low = [...box.low] as Box["low"];
  const high = [...box.high] as Box["high"];
  for (let view = 0; view < take.views; view++) {
    for (let frame = 0; frame < take.frames; frame++) {
      const place = poseOf(frame, view)?.elements;
      if (place === undefined) continue;
      for (let axis = 0; axis < 3; axis++) {
        low[axis] = Math.min(low[axis]!, place[12 + axis]!);
        high[axis] = Math.max(high[axis]!, place[12 + axis]!);
      }
      break;
    }
  }
  return { low, high };
}
