/** A grid under the subject whose squares have a length that is written beside it. */

import { BufferAttribute, BufferGeometry, LineBasicMaterial, LineSegments } from "three";
import { roundLength, type Box } from "../../science/extent.ts";
import type { Theme } from "../../parts/theme.ts";

export interface Floor {
  lines: LineSegments;
  square: number; // its side, in the unit of the points
  paint(theme: Theme): void;
}

/** @param size of the subject; @param level height of the grid */
export function createFloor(box: Box, size: number, level: number): Floor {
  const square = roundLength(size / 4);
  const reach = size * 0.9;
  const from = [0, 2].map((axis) => Math.floor((box.low[axis] - reach) / square));
  const to = [0, 2].map((axis) => Math.ceil((box.high[axis] + reach) / square));
  const ends: number[] = [];
  for (let x = from[0]; x <= to[0]; x++) {
    ends.push(x * square, level, from[1] * square, x * square, level, to[1] * square);
  }
  for (let z = from[1]; z <= to[1]; z++) {
    ends.push(from[0] * square, level, z * square, to[0] * square, level, z * square);
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(Float32Array.from(ends), 3));
  const material = new LineBasicMaterial({ transparent: true, opacity: 0.8 });
  return {
    lines: new LineSegments(geometry, material),
    square,
    paint: (theme) => material.color.set(theme.line),
  };
}
