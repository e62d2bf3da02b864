/** Frames to look at first. */

/** Returns up to `most` frames whose values are largest, the worst first, no two of them closer
 * than `apart` frames; NaN is no value. */
export function worstFrames(values: ArrayLike<number>, most: number, apart: number): number[] {
  const order: number[] = [];
  for (let frame = 0; frame < values.length; frame++) {
    if (Number.isFinite(values[frame])) order.push(frame);
  }
  order.sort((a, b) => values[b]! - values[a]!);
  const chosen: number[] = [];
  for (const frame of order) {
    if (chosen.length === most) break;
    if (chosen.every((other) => Math.abs(other - frame) >= apart)) chosen.push(frame);
  }
  return chosen;
}

/** Returns the value below which a share of the finite values lies; 0 if there are none. */
export function quantile(values: ArrayLike<number>, share: number): number {
  const known = Float64Array.from(values).filter(Number.isFinite).sort();
  if (known.length === 0) return 0;
  return known[Math.min(known.length - 1, Math.round(share * (known.length - 1)))]!;
}
