/** Pairs of numbers that lie one after the other in an array (n, 2). */

/** Returns pair number `index`; throws where the array does not reach so far. */
export function pairAt(numbers: ArrayLike<number>, index: number): [number, number] {
  const first = numbers[2 * index];
  const second = numbers[2 * index + 1];
  if (first === undefined || second === undefined) throw new RangeError(`There is no pair ${index}.`);
  return [first, second];
}

/** Returns all of them. */
export function pairsOf(numbers: ArrayLike<number>): [number, number][] {
  return Array.from({ length: numbers.length / 2 }, (_, index) => pairAt(numbers, index));
}
