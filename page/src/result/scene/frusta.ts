/** The cameras, as pyramids whose base is the image. */

import { BufferAttribute, BufferGeometry, Group, LineBasicMaterial, LineSegments, Matrix4 } from "three";
import type { Take } from "../../data/take.ts";
import { pairAt } from "../../science/pairs.ts";
import { NO_CAMERA, WEAK } from "../../science/projection.ts";
import type { Theme } from "../../parts/theme.ts";

export interface Frusta {
  group: Group;
  show(frame: number): void;
  paint(theme: Theme): void;
  /** The pose of a view: from its own axes (OpenCV's) to the scene's; null where there is none. */
  pose(frame: number, view: number): Matrix4 | null;
}

/** @param depth how far the base is from the camera, in the unit of the points */
export function createFrusta(take: Take, depth: number): Frusta {
  const { views, cameras } = take;
  const group = new Group();
  const material = new LineBasicMaterial({ transparent: true }); // the program of the floor's
  const shown = Array.from({ length: views }, (_, view) => {
    const lines = new LineSegments(pyramid(take, view, depth), material);
    lines.matrixAutoUpdate = false;
    lines.frustumCulled = false;
    group.add(lines);
    return lines;
  });

  function pose(frame: number, view: number): Matrix4 | null {
    const camera = frame * views + view;
    const model = cameras.models[camera];
    const R = cameras.rotations.subarray(9 * camera, 9 * camera + 9);
    const t = cameras.translations.subarray(3 * camera, 3 * camera + 3);
    if (model === NO_CAMERA || model === WEAK || !Number.isFinite(R[0]! + t[2]!)) return null;
    const centre = [0, 1, 2].map((axis) => -(R[axis]! * t[0]! + R[3 + axis]! * t[1]! + R[6 + axis]! * t[2]!));
    // prettier-ignore
    return new Matrix4().set(
      R[0]!, R[3]!, R[6]!, centre[0]!,
      R[1]!, R[4]!, R[7]!, centre[1]!,
      R[2]!, R[5]!, R[8]!, centre[2]!,
      0, 0, 0, 1,
    );
  }

  return {
    group,
    pose,
    show(frame) {
      shown.forEach((lines, view) => {
        const placed = pose(frame, view);
        lines.visible = placed !== null;
        if (placed !== null) {
          lines.matrix.copy(placed);
          lines.matrixWorldNeedsUpdate = true;
        }
      });
    },
    paint(theme) {
      material.color.set(theme.quiet);
    },
  };
}

/** Returns the edges of a view's pyramid in its own axes, by the first frame that has a lens. */
function pyramid(take: Take, view: number, depth: number): BufferGeometry {
  const { cameras, views, frames } = take;
  let camera = view;
  for (let frame = 0; frame < frames; frame++) {
    camera = frame * views + view;
    if (cameras.models[camera]! > WEAK) break;
  }
  const [fx, fy] = pairAt(cameras.focals, camera);
  const [cx, cy] = pairAt(cameras.principalPoints, camera);
  const [width, height] = take.imageSizes[view] ?? [2 * cx, 2 * cy];
  const corner = (x: number, y: number) => [((x - cx) / fx) * depth, ((y - cy) / fy) * depth, depth];
  const corners = [corner(0, 0), corner(width, 0), corner(width, height), corner(0, height)];
  const top = [corner(0.35 * width, 0), corner(0.5 * width, -0.14 * height), corner(0.65 * width, 0)];
  const ends: number[][] = [];
  corners.forEach((each, index) => {
    ends.push([0, 0, 0], each, each, corners[(index + 1) % 4]!);
  });
  ends.push(top[0]!, top[1]!, top[1]!, top[2]!); // which side is up in the image
  const geometry = new BufferGeometry();
  const places = Float32Array.from(ends.flat(), (value) => (Number.isFinite(value) ? value : 0));
  geometry.setAttribute("position", new BufferAttribute(places, 3));
  return geometry;
}
