/** Which keypoints are selected: a few, in the order in which they were chosen. */

import { useCallback, useLayoutEffect, useState } from "preact/hooks";

const MOST = 3; // what an angle takes

export interface Selection {
  selected: readonly number[]; // keypoints
  /** Selects a keypoint instead of the others or, `adding`, beside them; one that is selected is given up. */
  select(keypoint: number, adding?: boolean): void;
  setSelected(keypoints: readonly number[]): void;
}

/** Returns what is selected after a keypoint was clicked. Beside the `most` that there may be, the one
 * that was chosen first gives way. */
export function afterClick(
  selected: readonly number[],
  keypoint: number,
  adding: boolean,
  most = MOST,
): readonly number[] {
  const others = selected.filter((each) => each !== keypoint);
  const had = others.length < selected.length;
  if (adding) return had ? others : [...others, keypoint].slice(-most);
  return had && others.length === 0 ? [] : [keypoint];
}

/** Keeps a selection, which Escape clears.
 *
 * @param most keypoints that are selected at a time */
export function useSelection(most = MOST): Selection {
  const [selected, setSelected] = useState<readonly number[]>([]);
  useLayoutEffect(() => {
    const clear = (event: KeyboardEvent) => {
      if (event.key === "Escape") setSelected((before) => (before.length === 0 ? before : []));
    };
    window.addEventListener("keydown", clear);
    return () => window.removeEventListener("keydown", clear);
  }, []);
  const select = useCallback(
    (keypoint: number, adding = false) => setSelected((before) => afterClick(before, keypoint, adding, most)),
    [most],
  );
  return { selected, select, setSelected };
}
