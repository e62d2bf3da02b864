/** Lets keypoints of one view be corrected in its picture, while that is switched on. */

import type { RefObject } from "preact";
import { useEffect, useRef } from "preact/hooks";
import type { Place, Position } from "../../data/corrections.ts";
import { ALL } from "../../data/take.ts";
import { useShown } from "../show.ts";
import type { ViewDrawing } from "../view_drawing.ts";
import { dragOn, stepOf } from "./handle.ts";

/** Returns whether a keypoint is held just now, so that the picture stays where it is; and what keys do. */
export function useHandle(canvas: RefObject<HTMLCanvasElement | null>, drawing: ViewDrawing, view: number) {
  const shown = useShown();
  const now = useRef(shown);
  now.current = shown;
  const held = useRef(false);
  const { take, player, editing } = shown;
  const on = editing?.on ?? false;

  useEffect(() => {
    if (canvas.current === null || !on) return undefined;
    const placeOf = (keypoint: number): Place => ({ frame: player.frame, view, keypoint });
    const put = (keypoint: number, position: Position | null) => {
      if (take.there[player.frame] === ALL) now.current.editing?.put(placeOf(keypoint), position);
    };
    return dragOn(canvas.current, {
      places: () => drawing.places(),
      imageAt: (x, y) => drawing.imageAt(x, y),
      selected: () => now.current.selected,
      onHold(keypoint) {
        held.current = keypoint !== null;
        if (keypoint === null) return;
        player.playing = false;
        now.current.editing?.setView(view);
      },
      onMove(keypoint, position) {
        if (!now.current.selected.includes(keypoint)) now.current.setSelected([keypoint]);
        if (take.there[player.frame] === ALL) now.current.editing?.hold(placeOf(keypoint), position);
      },
      onPut: put,
      onGiveUp(keypoint) {
        now.current.editing?.release(placeOf(keypoint));
      },
    });
  }, [canvas, drawing, on, player, take, view]);

  /** Moves the selected keypoint of the view that has the focus. */
  const onKeyDown = (event: KeyboardEvent) => {
    const keypoint = shown.selected.at(-1);
    const step = stepOf(event);
    if (!on || editing === null || keypoint === undefined || step === null) return;
    const at = drawing.imageOf(keypoint);
    if (at === null || take.there[player.frame] !== ALL) return;
    event.preventDefault();
    event.stopPropagation(); // it moves a keypoint, and no frame
    editing.put({ frame: player.frame, view, keypoint }, [at[0] + step[0], at[1] + step[1]]);
  };
  return { held, on, onKeyDown };
}
