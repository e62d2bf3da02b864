/** All that is in the scene, in sizes that suit the subject's. */

import { Scene } from "three";
import type { Take } from "../../data/take.ts";
import type { Box } from "../../science/extent.ts";
import { createHulls } from "./doubt.ts";
import { createFloor } from "./floor.ts";
import { createFrusta } from "./frusta.ts";
import { createSkeleton } from "./skeleton.ts";
import { createTrails } from "./trails.ts";

/** Where a subject goes, and how large it is. */
export interface Extent {
  box: Box;
  size: number;
}

export function createParts(take: Take, { box, size }: Extent) {
  const onFloor = take.frame === "level" && Math.abs(box.low[1]) < 0.2 * size;
  const parts = {
    skeleton: createSkeleton(take, size / 70),
    ghost: createSkeleton(take, size / 52, true),
    hulls: createHulls(take),
    trails: createTrails(take, size / 2),
    floor: createFloor(box, size, onFloor ? 0 : box.low[1]),
    frusta: createFrusta(take, size / 3.2),
  };
  parts.ghost.group.visible = parts.hulls.mesh.visible = false;
  const scene = new Scene();
  scene.add(parts.skeleton.group, parts.ghost.group, parts.trails.lines, parts.floor.lines);
  scene.add(parts.frusta.group, parts.hulls.mesh);
  return { scene, ...parts };
}
