/** Reads npz files whose members are stored, as the API writes them: a zip of NumPy arrays. Of a long
 * file no more is read than is needed. */

import { latin, type NumericArray, type Tensor } from "./tensor.ts";

/** Returns the bytes of a file from a start up to an end; what is beyond the file is left out. */
export type Read = (start: number, end: number) => Promise<ArrayBuffer>;

export interface Npz {
  arrays: Map<string, Tensor>;
  texts: Map<string, string[]>;
}

/** An array in a file: what it holds, and where. */
export interface Member {
  name: string;
  kind: string; // as NumPy calls it, without the order of bytes: f4, U12
  shape: number[];
  start: number; // of its numbers in the file
  end: number;
}

const ENTRY = 0x02014b50; // of the directory
const END = 0x06054b50;
const ZIP64_END = 0x06064b50;
const IN_EXTRA = 0xffffffff; // the number stands in the ZIP64 field
const ARRAY_MAGIC = 8; // bytes: \x93NUMPY and two of the version
export const HEADER = 512; // bytes that hold a member's headers
export const TAIL = 65_536; // bytes at the end of a file that are read first: the directory is there

const KINDS: Record<string, new (bytes: ArrayBuffer) => NumericArray> = {
  f8: Float64Array,
  f4: Float32Array,
  i4: Int32Array,
  i2: Int16Array,
  i1: Int8Array,
  u4: Uint32Array,
  u2: Uint16Array,
  u1: Uint8Array,
  b1: Uint8Array,
};

/** Returns what arrays a file holds, by name. */
export async function membersOf(read: Read, size: number): Promise<Map<string, Member>> {
  const from = Math.max(0, size - TAIL);
  const entries = directoryOf(new DataView(await read(from, size)), from);
  const members = await Promise.all(entries.map((entry) => memberAt(read, entry)));
  return new Map(members.map((member) => [member.name, member]));
}

/** Returns the arrays and texts of some members of a file. */
export async function readMembers(read: Read, members: Member[]): Promise<Npz> {
  const found: Npz = { arrays: new Map(), texts: new Map() };
  for (const { name, kind, shape, start, end } of members) {
    const data = await read(start, end);
    const Kind = KINDS[kind];
    if (kind.startsWith("U")) found.texts.set(name, readTexts(data, Number(kind.slice(1))));
    else if (Kind !== undefined) found.arrays.set(name, { shape, data: new Kind(data) });
    else if (kind === "i8") {
      found.arrays.set(name, { shape, data: Int32Array.from(new BigInt64Array(data), Number) });
    }
  }
  return found;
}

interface Entry {
  name: string;
  offset: number; // of its local header
  size: number; // of what it holds
}

/** @param from where in the file the view begins */
function directoryOf(view: DataView, from: number): Entry[] {
  let end = view.byteLength - 22;
  while (end >= 0 && view.getUint32(end, true) !== END) end--;
  if (end < 0) throw new Error("This is no npz file.");
  let start = view.getUint32(end + 16, true);
  if (start === IN_EXTRA) {
    let long = end - 4;
    while (long >= 0 && view.getUint32(long, true) !== ZIP64_END) long--;
    start = Number(view.getBigUint64(long + 48, true));
  }
  const entries: Entry[] = [];
  let at = start - from;
  while (at >= 0 && at + 46 <= view.byteLength && view.getUint32(at, true) === ENTRY) {
    if (view.getUint16(at + 10, true) !== 0) throw new Error("A compressed npz cannot be read here.");
    const nameLength = view.getUint16(at + 28, true);
    const extra = at + 46 + nameLength;
    entries.push({ name: latin(view, at + 46, nameLength).replace(/\.npy$/, ""), ...placeOf(view, at, extra) });
    at = extra + view.getUint16(at + 30, true) + view.getUint16(at + 32, true);
  }
  return entries;
}

/** Reads size and offset of an entry, those of the ZIP64 field in its order where they stand there. */
function placeOf(view: DataView, entry: number, extra: number): { size: number; offset: number } {
  let long = extra + 4;
  const number = (at: number) => {
    const value = view.getUint32(at, true);
    if (value !== IN_EXTRA) return value;
    long += 8;
    return Number(view.getBigUint64(long - 8, true));
  };
  const size = number(entry + 24);
  number(entry + 20); // its size when packed
  return { size, offset: number(entry + 42) };
}

async function memberAt(read: Read, { name, offset, size }: Entry): Promise<Member> {
  const view = new DataView(await read(offset, offset + HEADER));
  const array = 30 + view.getUint16(26, true) + view.getUint16(28, true);
  const long = view.getUint8(array + 6) > 1; // version 2 has a length of four bytes
  const length = long ? view.getUint32(array + ARRAY_MAGIC, true) : view.getUint16(array + ARRAY_MAGIC, true);
  const text = array + ARRAY_MAGIC + (long ? 4 : 2);
  const header = latin(view, text, length);
  const kind = /'descr': '[<|=]?(\w\d+)'/.exec(header);
  const shape = /'shape': \(([^)]*)\)/.exec(header);
  if (kind?.[1] === undefined || shape?.[1] === undefined) throw new Error(`${name} is no array that can be read.`);
  return {
    name,
    kind: kind[1],
    shape: shape[1]
      .split(",")
      .filter((each) => each.trim())
      .map(Number),
    start: offset + text + length,
    end: offset + array + size,
  };
}

function readTexts(data: ArrayBuffer, size: number): string[] {
  const points = new Uint32Array(data);
  const texts: string[] = [];
  for (let start = 0; start < points.length; start += size) {
    const letters = points.subarray(start, start + size).filter((point) => point !== 0);
    texts.push(String.fromCodePoint(...letters));
  }
  return texts;
}
