/** Correcting keypoints of a result: what is shown at once, saved behind it, and can be undone. */

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type { Fit } from "../../api/resources.ts";
import type { Correction, Place, Position } from "../../data/corrections.ts";
import type { Result } from "../../data/loading.ts";
import type { Loop } from "../loop.ts";
import { createSaver, Overtaken, type Change } from "./saving.ts";

export interface Editing {
  on: boolean;
  setOn(on: boolean): void;
  view: number; // in which the selected keypoint is corrected
  setView(view: number): void;
  version: number; // rises with every correction
  list: readonly Correction[];
  at(place: Place): Correction | undefined;
  hold(place: Place, position: Position): void;
  /** Shows a keypoint again where it was before it was held. */
  release(place: Place): void;
  /** Has a keypoint be somewhere, nowhere (null), or where it was detected (undefined). */
  put(place: Place, position: Position | null | undefined): void;
  /** Takes back what was done last here, and returns where; null without anything. */
  undoLast(): Place | null;
  undoable: boolean;
  saving: boolean;
  trouble: string | null;
  outdated: boolean; // whether the fit was made with other corrections
}

export function useEditing(fit: Fit, result: Result, loop: Loop): Editing {
  const { corrected, take } = result;
  const [on, setOn] = useState(false);
  const [view, setView] = useState(0);
  const [version, setVersion] = useState(0);
  const [checksum, setChecksum] = useState(result.corrections.checksum);
  const [waiting, setWaiting] = useState(0); // changes that are not saved yet
  const [trouble, setTrouble] = useState<string | null>(null);
  const done = useRef<Change[]>([]); // what brings back the state before each change, the last one last
  const saver = useMemo(
    () => createSaver(fit.dataset_id, result.corrections.checksum, result.correctionsTag),
    [fit.dataset_id, result],
  );
  useEffect(() => loop.wake(), [loop, version]);

  const show = ({ place, position }: Change) => {
    corrected.put(place, position);
    setVersion((before) => before + 1);
  };
  const before = (place: Place): Change => ({ place, position: positionOf(corrected.at(place)) });
  const change = (next: Change, back: Change) => {
    show(next);
    setTrouble(null);
    setWaiting((count) => count + 1);
    saver
      .save(next)
      .then(setChecksum, (error: Error) => {
        setTrouble(error.message);
        done.current = done.current.filter((each) => each !== back);
        if (error instanceof Overtaken) {
          for (const each of corrected.list()) corrected.put(each);
          for (const each of error.now.items) corrected.put(each, positionOf(each) ?? null);
          done.current = [];
          setChecksum(error.now.checksum);
          setVersion((count) => count + 1);
        } else show(back);
      })
      .finally(() => setWaiting((count) => count - 1));
  };
  return {
    ...{ on, setOn, view, setView, version, trouble },
    // eslint-disable-next-line react-hooks/exhaustive-deps -- the version is of what is listed
    list: useMemo(() => corrected.list(), [corrected, version]),
    at: corrected.at,
    hold(place, position) {
      corrected.hold(place, position);
      loop.wake();
    },
    release(place) {
      corrected.put(place, positionOf(corrected.at(place)));
      loop.wake();
    },
    put(place, position) {
      const back = before(place);
      if (position === undefined && back.position === undefined) return;
      done.current.push(back);
      change({ place, position: position && inFigures(position) }, back);
    },
    undoLast() {
      const last = done.current.pop();
      if (last === undefined) return null;
      change(last, before(last.place));
      return last.place;
    },
    undoable: done.current.length > 0,
    saving: waiting > 0,
    outdated: waiting === 0 && checksum !== fit.corrections.checksum && take.frames > 0,
  };
}

function positionOf(correction: Correction | undefined): Position | null | undefined {
  if (correction === undefined) return undefined;
  const { position } = correction;
  return position === null ? null : [position[0]!, position[1]!];
}

/** Rounds to hundredths of a pixel: no hand is surer. */
function inFigures([x, y]: Position): Position {
  return [Math.round(100 * x) / 100, Math.round(100 * y) / 100];
}
