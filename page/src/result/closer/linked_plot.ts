/** A plot over frames that goes along with the player. */

import { useEffect, useRef } from "preact/hooks";
import type uPlot from "uplot";
import { useShow } from "../show.ts";

/** Links a plot with the player: a line shows the frame, and a press or drag goes to one.
 *
 * @param x (N,) where frames are along the plot */
export function useLinkedPlot(x: Float64Array): (plot: uPlot) => void {
  const { player, loop } = useShow();
  const drawn = useRef<{ plot: uPlot; line: HTMLElement } | null>(null);
  useEffect(
    () =>
      loop.add(() => {
        if (drawn.current === null) return;
        const { plot, line } = drawn.current;
        line.style.transform = `translateX(${plot.valToPos(x[player.frame]!, "x")}px)`;
      }),
    [loop, player, x],
  );
  return (plot) => {
    const line = document.createElement("i");
    line.className = "frame-line";
    plot.over.append(line);
    drawn.current = { plot, line };
    loop.wake();
    const seek = (event: PointerEvent) => {
      if (event.buttons !== 1) return;
      player.playing = false;
      player.show(nearestIn(x, plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x")));
    };
    plot.over.addEventListener("pointerdown", (event) => {
      plot.over.setPointerCapture(event.pointerId);
      seek(event);
    });
    plot.over.addEventListener("pointermove", seek);
  };
}

/** Returns the index of the value nearest to one, of values that rise. */
function nearestIn(rising: Float64Array, value: number): number {
  let [low, high] = [0, rising.length - 1];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (rising[middle]! <= value) low = middle;
    else high = middle;
  }
  return value - rising[low]! <= rising[high]! - value ? low : high;
}
