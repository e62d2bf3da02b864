/** Errors, keypoint x frame: a click goes to the frame and marks the keypoint. */

import { useEffect, useMemo, useRef } from "preact/hooks";
import { number } from "../parts/format.ts";
import { LEFT_OUT, UNSEEN } from "../science/errors.ts";
import { quantile } from "../science/worst.ts";
import { drawHeatMap, heatColours, isDark } from "./heat.ts";
import { useShow, type Show } from "./show.ts";

const CLEAR = 0.99; // of the errors are within the colours; larger ones have the last colour
const SAMPLES = 50_000; // errors that are looked at for that
const WIDEST = 2400; // columns

export interface Cell {
  frame: number;
  keypoint: number;
}

export function HeatMap({ onCell }: { onCell: (cell: Cell | null) => void }) {
  const { take, player, errors, errorsDone, theme, select, selected, setSelected } = useShow();
  const canvas = useRef<HTMLCanvasElement>(null);
  const largest = useKeypointLimit();
  useEffect(() => {
    if (canvas.current === null || !errorsDone) return;
    const columns = Math.min(take.frames, WIDEST);
    drawHeatMap(canvas.current, errors, take.keypoints, columns, largest, theme, heatColours(isDark()));
  }, [errors, errorsDone, largest, theme, take]);

  const cellAt = (event: MouseEvent): Cell => {
    const box = (event.currentTarget as HTMLElement).getBoundingClientRect();
    const frame = Math.floor(((event.clientX - box.left) / box.width) * take.frames);
    const keypoint = Math.floor(((event.clientY - box.top) / box.height) * take.keypoints);
    return {
      frame: Math.min(take.frames - 1, Math.max(0, frame)),
      keypoint: Math.min(take.keypoints - 1, Math.max(0, keypoint)),
    };
  };
  return (
    <div
      class="map"
      style={{ height: `${Math.min(200, Math.max(72, 4 * take.keypoints))}px` }}
      onMouseMove={(event) => onCell(cellAt(event))}
      onMouseLeave={() => onCell(null)}
      onClick={(event) => {
        const cell = cellAt(event);
        player.playing = false;
        player.show(cell.frame);
        if (event.shiftKey) select(cell.keypoint, true);
        else setSelected([cell.keypoint]);
      }}
    >
      <canvas ref={canvas} role="img" aria-label={`Errors of ${take.keypoints} keypoints over ${take.frames} frames`} />
      {selected.map((keypoint) => (
        <i
          key={keypoint}
          class="row"
          style={{ top: `${(100 * keypoint) / take.keypoints}%`, height: `${100 / take.keypoints}%` }}
        />
      ))}
    </div>
  );
}

/** What the colours mean. */
export function HeatKey() {
  const { errorsDone } = useShow();
  const largest = useKeypointLimit();
  return (
    <span class="key">
      0 <i class="ramp" /> {errorsDone ? `${number(largest)} px` : "…"}
      <i class="swatch outlier" /> outlier, left out <i class="swatch unseen-cell" /> not observed
    </span>
  );
}

export function cellText({ take, errors }: Show, { frame, keypoint }: Cell): string {
  const error = errors.worst[frame * take.keypoints + keypoint];
  const inferred = "not observed, inferred";
  const text = error === UNSEEN ? inferred : error === LEFT_OUT ? "outlier, left out" : `${number(error)} px`;
  return `${take.names[keypoint]}, frame ${frame}: ${text}`;
}

/** Returns the error that has the last colour, in pixels. */
function useKeypointLimit(): number {
  const { errors, errorsDone } = useShow();
  return useMemo(() => {
    if (!errorsDone) return 1;
    const step = Math.max(1, Math.floor(errors.worst.length / SAMPLES));
    const known: number[] = [];
    for (let at = 0; at < errors.worst.length; at += step) {
      const error = errors.worst[at]!;
      if (error >= 0) known.push(error);
    }
    return Math.max(quantile(known, CLEAR), 1e-6);
  }, [errors, errorsDone]);
}
