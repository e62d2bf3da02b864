/** Reads npz files whose members are stored, as the API writes them: a zip of NumPy arrays. */

import type { NumericArray, Tensor } from "./tensor.ts";

export interface Npz {
  arrays: Map<string, Tensor>;
  texts: Map<string, string[]>;
}

const LOCAL = 0x04034b50;
const ZIP64 = 0xffffffff;
const ARRAY_MAGIC = 8; // bytes: \x93NUMPY and two of the version

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

/** Returns the arrays and texts of a file by name. */
export function readNpz(file: ArrayBuffer): Npz {
  const view = new DataView(file);
  const found: Npz = { arrays: new Map(), texts: new Map() };
  let at = 0;
  while (at + 30 <= file.byteLength && view.getUint32(at, true) === LOCAL) {
    const member = readMember(file, view, at);
    readArray(file.slice(member.start, member.end), member.name, found);
    at = member.end;
  }
  return found;
}

function readMember(file: ArrayBuffer, view: DataView, at: number) {
  if (view.getUint16(at + 8, true) !== 0) throw new Error("A compressed npz cannot be read here.");
  const nameLength = view.getUint16(at + 26, true);
  const extraLength = view.getUint16(at + 28, true);
  const name = new TextDecoder().decode(new Uint8Array(file, at + 30, nameLength));
  const extra = at + 30 + nameLength;
  let size = view.getUint32(at + 18, true);
  if (size === ZIP64) size = Number(view.getBigUint64(extra + 4, true)); // its first field
  const start = extra + extraLength;
  return { name: name.replace(/\.npy$/, ""), start, end: start + size };
}

function readArray(bytes: ArrayBuffer, name: string, found: Npz): void {
  const view = new DataView(bytes);
  const long = view.getUint8(6) > 1; // version 2 has a length of four bytes
  const length = long ? view.getUint32(ARRAY_MAGIC, true) : view.getUint16(ARRAY_MAGIC, true);
  const start = ARRAY_MAGIC + (long ? 4 : 2);
  const header = new TextDecoder("latin1").decode(new Uint8Array(bytes, start, length));
  const kind = /'descr': '[<|=]?(\w)(\d+)'/.exec(header);
  const shape = /'shape': \(([^)]*)\)/.exec(header);
  if (kind === null || shape === null) throw new Error(`${name} is no array that can be read.`);
  const dimensions = shape[1].split(",").filter((text) => text.trim()).map(Number);
  const data = bytes.slice(start + length);
  const size = Number(kind[2]);
  const Kind = KINDS[`${kind[1]}${kind[2]}`];
  if (kind[1] === "U") found.texts.set(name, readTexts(data, size));
  else if (Kind !== undefined) found.arrays.set(name, { shape: dimensions, data: new Kind(data) });
  else if (kind[1] + kind[2] === "i8") {
    const numbers = Int32Array.from(new BigInt64Array(data), Number);
    found.arrays.set(name, { shape: dimensions, data: numbers });
  }
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
