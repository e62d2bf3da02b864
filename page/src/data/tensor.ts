/** Numbers with a shape, row after row, as NumPy lays them out in C order. */

export type NumericArray =
  | Float64Array<ArrayBuffer>
  | Float32Array<ArrayBuffer>
  | Int32Array<ArrayBuffer>
  | Int16Array<ArrayBuffer>
  | Int8Array<ArrayBuffer>
  | Uint32Array<ArrayBuffer>
  | Uint16Array<ArrayBuffer>
  | Uint8Array<ArrayBuffer>;

export interface Tensor {
  shape: number[];
  data: NumericArray;
}

/** Returns an array of floats by name, or undefined if the file has none. */
export function floats(file: Map<string, Tensor>, name: string): Float32Array | undefined {
  const found = file.get(name);
  if (found === undefined) return undefined;
  return found.data instanceof Float32Array ? found.data : Float32Array.from(found.data);
}

/** Does the same for an array that must be there. */
export function needed(file: Map<string, Tensor>, name: string): Float32Array {
  const found = floats(file, name);
  if (found === undefined) throw new Error(`The file has no array ${name}.`);
  return found;
}

/** Returns text of single bytes. */
export function latin(view: DataView, start: number, length: number): string {
  return new TextDecoder("latin1").decode(new Uint8Array(view.buffer, view.byteOffset + start, length));
}
