/** Reads safetensors: eight bytes of length, a JSON header, then the arrays' bytes. */

import type { NumericArray, Tensor } from "./tensor.ts";

const KINDS: Record<string, new (bytes: ArrayBuffer) => NumericArray> = {
  F64: Float64Array,
  F32: Float32Array,
  I32: Int32Array,
  I16: Int16Array,
  I8: Int8Array,
  U32: Uint32Array,
  U16: Uint16Array,
  U8: Uint8Array,
  BOOL: Uint8Array,
};

type Entry = { dtype: string; shape: number[]; data_offsets: [number, number] };

/** Returns the arrays of a file by name; those of 64-bit integers, which nothing here needs, are
 * left out. */
export function readSafetensors(file: ArrayBuffer): Map<string, Tensor> {
  const length = Number(new DataView(file).getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(file, 8, length))) as Record<string, Entry>;
  const found = new Map<string, Tensor>();
  for (const [name, entry] of Object.entries(header)) {
    const Kind = KINDS[entry.dtype];
    if (name === "__metadata__" || Kind === undefined) continue;
    const [start, end] = entry.data_offsets;
    const bytes = file.slice(8 + length + start, 8 + length + end); // a copy, so it is aligned
    found.set(name, { shape: entry.shape, data: new Kind(bytes) });
  }
  return found;
}
