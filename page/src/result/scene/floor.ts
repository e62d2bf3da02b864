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
  const before = (low: number) => Math.floor((low - reach) / square);
  const beyond = (high: number) => Math.ceil((high + reach) / square);
  const [left, right] = [before(box.low[0]), beyond(box.high[0])];
  const [back, front] = [before(box.low[2]), beyond(box.high[2])];
  const ends: number[] = [];
  for (let x = left; x <= right; x++) ends.push(x * square, level, back * square, x * square, level, front * square);
  for (let z = back; z <= front; z++) ends.push(left * square, level, z * square, right * square, level, z * square);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(Float32Array.from(ends), 3));
  const material = new LineBasicMaterial({ transparent: true, opacity: 0.8 });
  return {
    lines: new LineSegments(geometry, material),
    square,
    paint: (theme) => material.color.set(theme.line),
  };
}
