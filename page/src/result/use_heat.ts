/** What the heat map shows: reprojection errors, or how far points may be off. */

import { useMemo } from "preact/hooks";
import { useKept } from "../parts/kept.ts";
import type { Numbers } from "../science/numbers.ts";
import { quantile } from "../science/worst.ts";
import type { Show } from "./show.ts";

export const ERROR = "error";
export const DOUBT = "doubt";

const CLEAR = 0.99; // of the numbers are within the colours; larger ones have the last colour
const SAMPLES = 50_000; // numbers that are looked at for that

export interface Heat {
  what: string; // ERROR or DOUBT
  choices: string[];
  choose: (what: string) => void;
  values: Numbers; // (N, P)
  largest: number; // that has the last colour
  unit: string; // as it follows a number
  done: boolean;
}

export function useHeat({ take, errors, errorsDone, unit, version, done }: Show): Heat {
  const [chosen, choose] = useKept("heat-map", ERROR);
  // eslint-disable-next-line react-hooks/exhaustive-deps -- the version is of what the take's arrays hold
  const known = useMemo(() => quantile(sampleOf(take.deviations), CLEAR), [take, version]);
  const worst = useMemo(() => (errorsDone ? quantile(sampleOf(errors.worst), CLEAR) : 1), [errors, errorsDone]);
  const ofDoubt = chosen === DOUBT && known > 0;
  return {
    choices: known > 0 ? [ERROR, DOUBT] : [ERROR],
    choose,
    ...(ofDoubt
      ? { what: DOUBT, values: take.deviations, largest: known, unit: ` (${unit})`, done }
      : { what: ERROR, values: errors.worst, largest: Math.max(worst, 1e-6), unit: " px", done: errorsDone }),
  };
}

/** Returns some of the numbers that are no marks. */
function sampleOf(values: Numbers): number[] {
  const step = Math.max(1, Math.floor(values.length / SAMPLES));
  const known: number[] = [];
  for (let at = 0; at < values.length; at += step) {
    const value = values[at]!;
    if (value >= 0) known.push(value); // false for NaN
  }
  return known;
}
