/** A long file of arrays, cut into parts that are sent one after the other: what was sent of it need
 * not be sent again. */

import { membersOf, readMembers, type Member } from "../data/npz.ts";
import { floats, type Tensor } from "../data/tensor.ts";
import { pairsOf } from "../science/pairs.ts";

export interface Parts {
  frames: number;
  size: number; // frames of a part
  description: Record<string, string>; // fields of a form, as JSON
  /** Returns frames from `first` up to `end` as a file of their own. */
  part(first: number, end: number): Blob;
}

/** An array of a file, wherever its bytes lie. */
interface Placed {
  name: string;
  dtype: string; // as safetensors calls it
  shape: number[];
  start: number;
  end: number;
}

export const PART_BYTES = 4_000_000;
const OF_FRAMES = ["keypoints", "confidence", "points3d", "times"];
const OF_ALL = ["keypoint_names", "edges", "image_sizes", "view_names", "fps"];
const DTYPES: Record<string, string> = { f4: "F32", f8: "F64", i4: "I32", i8: "I64", i2: "I16", u2: "U16", u1: "U8" };
const BYTES: Record<string, number> = { F64: 8, I64: 8, F32: 4, I32: 4, I16: 2, U16: 2, U8: 1 };

/** Returns how a file can be cut; null if it is short, or of a kind that cannot. */
export async function partsOf(file: File, bytes = PART_BYTES): Promise<Parts | null> {
  if (file.size <= 2 * bytes) return null;
  try {
    const { arrays, description } = file.name.toLowerCase().endsWith(".npz")
      ? await inNpz(file)
      : await inSafetensors(file);
    const frames = arrays.find(({ name }) => name === "keypoints")?.shape[0];
    const whole = arrays.every(({ dtype, shape }) => dtype in BYTES && shape[0] === frames);
    if (frames === undefined || !whole) return null;
    const each = arrays.reduce((sum, array) => sum + (array.end - array.start) / frames, 0);
    const size = Math.max(1, Math.floor(bytes / each));
    return { frames, size, description, part: (first, end) => cut(file, arrays, frames, first, end) };
  } catch {
    return null; // it is sent as it is, and the service says what is wrong with it
  }
}

async function inNpz(file: File): Promise<{ arrays: Placed[]; description: Record<string, string> }> {
  const read = (start: number, end: number) => file.slice(start, end).arrayBuffer();
  const members = await membersOf(read, file.size);
  const of = (names: string[]) => names.flatMap((name) => members.get(name) ?? []);
  const { arrays, texts } = await readMembers(read, of(OF_ALL));
  return {
    arrays: of(OF_FRAMES).map(({ kind, ...member }: Member) => ({ ...member, dtype: DTYPES[kind] ?? kind })),
    description: described(arrays, texts),
  };
}

async function inSafetensors(file: File): Promise<{ arrays: Placed[]; description: Record<string, string> }> {
  const length = Number(new DataView(await file.slice(0, 8).arrayBuffer()).getBigUint64(0, true));
  type Entry = { dtype: string; shape: number[]; data_offsets: [number, number] };
  const header = JSON.parse(await file.slice(8, 8 + length).text()) as Record<string, Entry>;
  const place = (name: string): Placed[] => {
    const entry = header[name];
    if (entry === undefined) return [];
    const [start, end] = entry.data_offsets;
    const from = 8 + length; // offsets count from there
    return [{ name, dtype: entry.dtype, shape: entry.shape, start: from + start, end: from + end }];
  };
  const tensors = new Map<string, Tensor>();
  for (const { name, dtype, shape, start, end } of OF_ALL.flatMap(place)) {
    const bytes = await file.slice(start, end).arrayBuffer();
    const read = KINDS[dtype];
    if (read === undefined) throw new Error(`${name} has numbers of another kind: ${dtype}.`);
    tensors.set(name, { shape, data: read(bytes) });
  }
  return { arrays: OF_FRAMES.flatMap(place), description: described(tensors, new Map()) };
}

const KINDS: Record<string, (bytes: ArrayBuffer) => Tensor["data"]> = {
  F32: (bytes) => new Float32Array(bytes),
  F64: (bytes) => new Float64Array(bytes),
  I32: (bytes) => new Int32Array(bytes),
  I64: (bytes) => Int32Array.from(new BigInt64Array(bytes), Number),
};

/** Returns what a file says of all of its frames, as fields of a form. */
function described(arrays: Map<string, Tensor>, texts: Map<string, string[]>): Record<string, string> {
  const edges = floats(arrays, "edges");
  const sizes = floats(arrays, "image_sizes");
  const fps = floats(arrays, "fps");
  const names = texts.get("keypoint_names");
  const fields: Record<string, string> = {};
  const skeleton = { ...(names && { keypoint_names: names }), ...(edges && { edges: pairsOf(edges) }) };
  if (names || edges) fields.skeleton = JSON.stringify(skeleton);
  if (sizes) fields.image_sizes = JSON.stringify(pairsOf(sizes).map((size) => (size[0] > 0 ? size : null)));
  if (texts.has("view_names")) fields.view_names = JSON.stringify(texts.get("view_names"));
  if (fps) fields.fps = `${fps[0]}`;
  return fields;
}

/** Returns frames as safetensors, whose bytes are read when they are sent. */
function cut(file: File, arrays: Placed[], frames: number, first: number, end: number): Blob {
  const header: Record<string, object> = {};
  const pieces: Blob[] = [];
  let offset = 0;
  for (const { name, dtype, shape, start, end: last } of arrays) {
    const each = (last - start) / frames;
    pieces.push(file.slice(start + first * each, start + end * each));
    const size = (end - first) * each;
    header[name] = { dtype, shape: [end - first, ...shape.slice(1)], data_offsets: [offset, offset + size] };
    offset += size;
  }
  const text = new TextEncoder().encode(JSON.stringify(header));
  const padded = new Uint8Array(8 * Math.ceil(text.length / 8)).fill(32);
  padded.set(text);
  const length = new ArrayBuffer(8);
  new DataView(length).setBigUint64(0, BigInt(padded.length), true);
  return new Blob([length, padded, ...pieces]);
}
