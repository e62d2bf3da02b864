/** Joints and bones of one frame, drawn with two calls however many there are. */

import { Color, CylinderGeometry, DynamicDrawUsage, Group, IcosahedronGeometry, InstancedMesh } from "three";
import type { Take } from "../../data/take.ts";
import { colourOf, type Theme } from "../../parts/theme.ts";
import type { Numbers } from "../../science/numbers.ts";
import type { Joined } from "../show.ts";
import { litMaterial } from "./lit_material.ts";

const GHOST = 0.3; // opacity
const BONE = 0.45; // radius of a bone, as a share of a joint's
const MOST_LOST = 0.88; // share of a colour that a keypoint may lose to that of the panel

export interface Skeleton {
  group: Group;
  /** @param lost how much of its colour each keypoint loses (P,), if any does */
  show(frame: number, points: Numbers, lost?: Float32Array): void;
  paint(theme: Theme, selected: readonly number[]): void;
  /** Draws other edges, until it is called with null; those that are offered stand out. Paint after it. */
  join(joined: Joined | null): void;
}

/** @param size radius of a joint, in the unit of the points
 * @param ghost whether it is another's structure, which is drawn as a pale hull */
export function createSkeleton(take: Take, size: number, ghost = false): Skeleton {
  const { keypoints, sides } = take;
  const material = litMaterial(ghost ? GHOST : 1);
  const cylinder = new CylinderGeometry(1, 1, 1, 10, 1, true);
  const joints = changing(new InstancedMesh(new IcosahedronGeometry(1, 2), material, keypoints));
  const group = new Group().add(joints);
  let joined: Joined = { edges: take.edges, offered: false };
  let bones = bonesOf(joined);
  let chosen: readonly number[] = [];
  let theme: Theme | null = null;
  let fading = false;

  function bonesOf({ edges }: Joined): InstancedMesh {
    const made = changing(new InstancedMesh(cylinder, material, edges.length));
    if (edges.length > 0) group.add(made);
    return made;
  }

  function colourAll(lost?: Float32Array): void {
    if (theme === null) return;
    const ground = new Color(theme.panel).convertLinearToSRGB(); // as eyes count: else less would be lost in the dark
    const colour = new Color();
    const put = (mesh: InstancedMesh, index: number, name: string, loss: number) => {
      colour
        .set(name)
        .convertLinearToSRGB()
        .lerp(ground, MOST_LOST * loss);
      mesh.setColorAt(index, colour.convertSRGBToLinear());
    };
    for (let keypoint = 0; keypoint < keypoints; keypoint++) {
      const plain = ghost ? theme.accent : colourOf(theme, sides[keypoint]!);
      put(joints, keypoint, chosen.includes(keypoint) ? theme.accent : plain, lost?.[keypoint] ?? 0);
    }
    for (const [edge, [a, b]] of joined.edges.entries()) {
      const side = sides[a]! || sides[b]!; // a bone from the trunk belongs to its limb
      const name = ghost || joined.offered ? theme.accent : colourOf(theme, side);
      put(bones, edge, name, lost === undefined ? 0 : Math.max(lost[a]!, lost[b]!));
    }
    for (const mesh of [joints, bones]) {
      if (mesh.instanceColor !== null) mesh.instanceColor.needsUpdate = true;
    }
  }

  return {
    group,
    join(other) {
      group.remove(bones);
      bones.dispose();
      joined = other ?? { edges: take.edges, offered: false };
      bones = bonesOf(joined);
    },
    show(frame, points, lost) {
      if (lost !== undefined || fading) colourAll(lost);
      fading = lost !== undefined;
      const first = 3 * keypoints * frame;
      const spheres = joints.instanceMatrix.array;
      for (let keypoint = 0; keypoint < keypoints; keypoint++) {
        const radius = chosen.includes(keypoint) ? 1.9 * size : size;
        writeSphere(spheres, 16 * keypoint, points, first + 3 * keypoint, radius);
      }
      const cylinders = bones.instanceMatrix.array;
      joined.edges.forEach(([a, b], edge) => {
        writeCylinder(cylinders, 16 * edge, points, first + 3 * a, first + 3 * b, BONE * size);
      });
      joints.instanceMatrix.needsUpdate = bones.instanceMatrix.needsUpdate = true;
    },
    paint(next, selected) {
      theme = next;
      chosen = selected;
      colourAll();
    },
  };
}

/** Prepares instances that are elsewhere in each frame. */
function changing(mesh: InstancedMesh): InstancedMesh {
  mesh.instanceMatrix.setUsage(DynamicDrawUsage);
  mesh.frustumCulled = false;
  return mesh;
}

/** Writes the matrix of a sphere; one without a place has no size. */
function writeSphere(
  into: Float32Array | ArrayLike<number>,
  at: number,
  points: Numbers,
  point: number,
  radius: number,
): void {
  const matrix = into as Float32Array;
  const x = points[point]!;
  const known = x === x; // not NaN
  const size = known ? radius : 0;
  matrix.fill(0, at, at + 16);
  matrix[at] = matrix[at + 5] = matrix[at + 10] = size;
  matrix[at + 12] = known ? x : 0;
  matrix[at + 13] = known ? points[point + 1]! : 0;
  matrix[at + 14] = known ? points[point + 2]! : 0;
  matrix[at + 15] = 1;
}

/** Writes the matrix that leads the unit cylinder along y from one point to another. */
function writeCylinder(
  into: Float32Array | ArrayLike<number>,
  at: number,
  points: Numbers,
  a: number,
  b: number,
  radius: number,
): void {
  const matrix = into as Float32Array;
  const dx = points[b]! - points[a]!;
  const dy = points[b + 1]! - points[a + 1]!;
  const dz = points[b + 2]! - points[a + 2]!;
  const length = Math.sqrt(dx * dx + dy * dy + dz * dz);
  matrix.fill(0, at, at + 16);
  matrix[at + 15] = 1;
  if (!(length > 0)) return; // NaN, or no length
  // Two directions across the bone: (dy, -dx, 0) or, along z, (0, dz, -dy).
  const flat = Math.abs(dz) < 0.9 * length;
  const across = flat ? Math.sqrt(dx * dx + dy * dy) : Math.sqrt(dy * dy + dz * dz);
  const ux = flat ? dy / across : 0;
  const uy = flat ? -dx / across : dz / across;
  const uz = flat ? 0 : -dy / across;
  matrix[at] = radius * ux;
  matrix[at + 1] = radius * uy;
  matrix[at + 2] = radius * uz;
  matrix[at + 4] = dx;
  matrix[at + 5] = dy;
  matrix[at + 6] = dz;
  matrix[at + 8] = (radius * (uy * dz - uz * dy)) / length;
  matrix[at + 9] = (radius * (uz * dx - ux * dz)) / length;
  matrix[at + 10] = (radius * (ux * dy - uy * dx)) / length;
  matrix[at + 12] = points[a]! + dx / 2;
  matrix[at + 13] = points[a + 1]! + dy / 2;
  matrix[at + 14] = points[a + 2]! + dz / 2;
}
