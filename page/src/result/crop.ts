/** Which part of a view's image its panel shows. */

import { ALL, type Take } from "../data/take.ts";
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
const SAMPLES = 600; // frames that are looked at for what holds of all
const FARTHEST = 300; // frames on either side in which a subject is sought

/** Returns the part that is shown in each frame. */
export function partsOf(take: Take, view: number, crop: Crop): (frame: number) => Part {
  const boxes = sampledBoxes(take, view);
  if (crop === "image" || boxes.length === 0) return always(imagePart(take, view, boxes));
  const size = quantile(boxes.map(sizeOf), 0.9);
  return crop === "path" ? always(pathPart(boxes, size)) : following(take, view, size);
}

function always(part: Part): (frame: number) => Part {
  return () => part;
}

/** The box around what a view shows in a frame. */
interface Box {
  left: number; // pixels, as the others
  right: number;
  top: number;
  bottom: number;
}

function sizeOf({ left, right, top, bottom }: Box): number {
  return Math.max(right - left, bottom - top);
}

function boxOf({ views, keypoints, detected }: Take, view: number, frame: number): Box | null {
  const first = (frame * views + view) * keypoints;
  let [left, right, top, bottom] = [Infinity, -Infinity, Infinity, -Infinity];
  for (let seen = 2 * first; seen < 2 * (first + keypoints); seen += 2) {
    const [x, y] = [detected[seen]!, detected[seen + 1]!];
    if (x < left) left = x; // false for NaN
    if (x > right) right = x;
    if (y < top) top = y;
    if (y > bottom) bottom = y;
  }
  return right < left ? null : { left, right, top, bottom };
}

/** Returns boxes of frames that are there, some hundred of many. */
function sampledBoxes(take: Take, view: number): Box[] {
  const known: number[] = [];
  for (let frame = 0; frame < take.frames; frame++) if (take.there[frame] === ALL) known.push(frame);
  const step = Math.max(1, Math.floor(known.length / SAMPLES));
  return known.flatMap((frame, index) => (index % step === 0 ? (boxOf(take, view, frame) ?? []) : []));
}

function pathPart(boxes: Box[], size: number): Part {
  const reach = (side: keyof Box, share: number) =>
    quantile(
      boxes.map((box) => box[side]),
      share,
    );
  const x = reach("left", ASTRAY) - MARGIN * size;
  const y = reach("top", ASTRAY) - MARGIN * size;
  const width = reach("right", 1 - ASTRAY) + MARGIN * size - x;
  const height = reach("bottom", 1 - ASTRAY) + MARGIN * size - y;
  return { x, y, width, height };
}

function following(take: Take, view: number, size: number): (frame: number) => Part {
  const side = (1 + 2 * MARGIN) * size;
  const boxAt = (frame: number) => (take.there[frame] === ALL ? boxOf(take, view, frame) : null); // also beyond the ends
  return (frame) => {
    let [x, y, count] = [0, 0, 0];
    for (let near = 0; near <= SMOOTHING || (count === 0 && near < FARTHEST); near++) {
      for (const at of near === 0 ? [frame] : [frame - near, frame + near]) {
        const box = boxAt(at);
        if (box === null) continue;
        x += (box.left + box.right) / 2;
        y += (box.top + box.bottom) / 2;
        count++;
      }
    }
    const found = Math.max(1, count); // with nothing near: about the origin
    return { x: x / found - side / 2, y: y / found - side / 2, width: side, height: side };
  };
}

/** Returns the whole image; where its size is not known, as far as keypoints reach. */
function imagePart(take: Take, view: number, boxes: Box[]): Part {
  const size = take.imageSizes[view] ?? null;
  if (size !== null) return { x: 0, y: 0, width: size[0], height: size[1] };
  const [width, height] = [boxes.map((box) => box.right), boxes.map((box) => box.bottom)];
  return { x: 0, y: 0, width: quantile(width, 1) || 1, height: quantile(height, 1) || 1 };
}
