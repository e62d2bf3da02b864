/** Where keypoints came from: lines through the last frames that fade with age. */

import { BufferAttribute, BufferGeometry, Color, DynamicDrawUsage, LineBasicMaterial, LineSegments } from "three";
import type { Take } from "../../data/take.ts";
import { colourOf, type Theme } from "../../parts/theme.ts";
import type { Numbers } from "../../science/numbers.ts";

const LENGTH = 24; // frames

export interface Trails {
  lines: LineSegments;
  show(frame: number): void;
  paint(theme: Theme, followed: readonly number[]): void;
}

/** @param jump longest step between two frames that is drawn: beyond it a new scene begins */
export function createTrails(take: Take, jump: number): Trails {
  const { points, keypoints, sides } = take;
  const vertices = 2 * LENGTH * keypoints;
  const places = new BufferAttribute(new Float32Array(3 * vertices), 3).setUsage(DynamicDrawUsage);
  const colours = new BufferAttribute(new Float32Array(4 * vertices), 4);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", places);
  geometry.setAttribute("color", colours);
  const material = new LineBasicMaterial({ vertexColors: true, transparent: true, depthWrite: false });
  const lines = new LineSegments(geometry, material);
  lines.frustumCulled = false;
  let keypointsShown: readonly number[] = [];

  return {
    lines,
    show(frame) {
      const into = places.array as Float32Array;
      let at = 0;
      for (const keypoint of keypointsShown) {
        for (let age = 0; age < LENGTH; age++) {
          const later = 3 * ((frame - age) * keypoints + keypoint);
          const earlier = later - 3 * keypoints;
          if (earlier < 0 || !isStep(points, earlier, later, jump)) {
            into.fill(0, at, at + 6); // a line without a length is not drawn
          } else {
            for (let axis = 0; axis < 3; axis++) {
              into[at + axis] = points[later + axis]!;
              into[at + 3 + axis] = points[earlier + axis]!;
            }
          }
          at += 6;
        }
      }
      places.needsUpdate = true;
    },
    paint(theme, followed) {
      keypointsShown = followed;
      geometry.setDrawRange(0, 2 * LENGTH * followed.length);
      const colour = new Color();
      const into = colours.array as Float32Array;
      let at = 0;
      for (const keypoint of followed) {
        colour.set(colourOf(theme, sides[keypoint]!));
        for (let age = 0; age < LENGTH; age++) {
          for (const end of [age, age + 1]) {
            into.set([colour.r, colour.g, colour.b, 0.75 * (1 - end / LENGTH)], at);
            at += 4;
          }
        }
      }
      colours.needsUpdate = true;
    },
  };
}

function isStep(points: Numbers, a: number, b: number, jump: number): boolean {
  const dx = points[b]! - points[a]!;
  const dy = points[b + 1]! - points[a + 1]!;
  const dz = points[b + 2]! - points[a + 2]!;
  return dx * dx + dy * dy + dz * dz < jump * jump; // false for NaN
}

/** Returns the keypoints whose trails show most: the ends of chains of bones. */
export function endsOf(take: Take): number[] {
  const degree = new Array<number>(take.keypoints).fill(0);
  for (const [a, b] of take.edges) {
    degree[a]!++;
    degree[b]!++;
  }
  const ends = degree.flatMap((count, keypoint) => (count === 1 ? [keypoint] : []));
  return ends.length > 0 ? ends : degree.map((_, keypoint) => keypoint);
}
