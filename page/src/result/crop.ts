/** Which part of a view's image its panel shows. */

import type { Take } from "../data/take.ts";
import { quantile } from "../science/worst.ts";

/** A part of an image, in its pixels. */
export interface Part {
  x: number;
  y: number;
  width: number;
  height: number;
}

/** `subject`: near the subject, following it; `path`: wherever it goes; `image`: all of the image. */
export type Crop = "subject" | "path" | "image";

const SMOOTHING = 12; // frames on either side over which the window's way is averaged
const MARGIN = 0.14; // of the subject's size, on either side
const ASTRAY = 0.003; // share of coordinates at either end that does not count

/** Returns the part that is shown in each frame. */
export function partsOf(take: Take, view: number, crop: Crop): (frame: number) => Part {
  if (crop === "image") return always(imagePart(take, view));
  const boxes = boxesOf(take, view);
  if (boxes.size === 0) return always(imagePart(take, view));
  return crop === "path" ? always(pathPart(boxes)) : following(boxes);
}

function always(part: Part): (frame: number) => Part {
  return () => part;
}

interface Boxes {
  left: Float32Array; // (N,) pixels, as the others; NaN where the view shows nothing
  right: Float32Array;
  top: Float32Array;
  bottom: Float32Array;
  size: number; // of the subject in most frames, 0 if it is never seen
}

function boxesOf({ frames, views, keypoints, detected }: Take, view: number): Boxes {
  const [left, right, top, bottom] = [0, 0, 0, 0].map(() => new Float32Array(frames).fill(NaN));
  const sizes = new Float32Array(frames).fill(NaN);
  for (let frame = 0; frame < frames; frame++) {
    const first = (frame * views + view) * keypoints;
    let [low, high, above, below] = [Infinity, -Infinity, Infinity, -Infinity];
    for (let seen = 2 * first; seen < 2 * (first + keypoints); seen += 2) {
      const [x, y] = [detected[seen], detected[seen + 1]];
      if (x < low) low = x; // false for NaN
      if (x > high) high = x;
      if (y < above) above = y;
      if (y > below) below = y;
    }
    if (high < low) continue;
    [left[frame], right[frame], top[frame], bottom[frame]] = [low, high, above, below];
    sizes[frame] = Math.max(high - low, below - above);
  }
  return { left, right, top, bottom, size: quantile(sizes, 0.9) };
}

function pathPart({ left, right, top, bottom, size }: Boxes): Part {
  const x = quantile(left, ASTRAY) - MARGIN * size;
  const y = quantile(top, ASTRAY) - MARGIN * size;
  const width = quantile(right, 1 - ASTRAY) + MARGIN * size - x;
  const height = quantile(bottom, 1 - ASTRAY) + MARGIN * size - y;
  return { x, y, width, height };
}

function following({ left, right, top, bottom, size }: Boxes): (frame: number) => Part {
  const side = (1 + 2 * MARGIN) * size;
  const middle = (low: Float32Array, high: Float32Array, frame: number) => {
    let [sum, count] = [0, 0];
    for (let near = 0; near <= SMOOTHING || count === 0; near++) {
      if (near > low.length) return 0;
      for (const at of near === 0 ? [frame] : [frame - near, frame + near]) {
        const centre = (low[at] + high[at]) / 2;
        if (!(centre === centre)) continue; // nothing is seen there, or no such frame
        sum += centre;
        count++;
      }
    }
    return sum / count;
  };
  return (frame) => ({
    x: middle(left, right, frame) - side / 2,
    y: middle(top, bottom, frame) - side / 2,
    width: side,
    height: side,
  });
}

/** Returns the whole image; where its size is not known, as far as keypoints reach. */
function imagePart(take: Take, view: number): Part {
  const size = take.imageSizes[view];
  if (size !== null) return { x: 0, y: 0, width: size[0], height: size[1] };
  const { right, bottom } = boxesOf(take, view);
  return { x: 0, y: 0, width: quantile(right, 1) || 1, height: quantile(bottom, 1) || 1 };
}
