/** Numbers of an array as those see them who read it; who writes them has it as the typed array that it is. */
export interface Numbers extends Iterable<number> {
  readonly length: number;
  readonly [index: number]: number;
  subarray(start?: number, end?: number): Numbers;
}
