/** Errors, or how far points may be off, keypoint x frame: a click goes to the frame and marks the keypoint. */

import { useEffect, useRef } from "preact/hooks";
import { number } from "../parts/format.ts";
import { LEFT_OUT, UNSEEN } from "../science/errors.ts";
import { drawHeatMap, heatColours, isDark } from "./heat.ts";
import { DOUBT, ERROR, type Heat } from "./use_heat.ts";
import { useShow, type Show } from "./show.ts";

const WIDEST = 2400; // columns

export interface Cell {
  frame: number;
  keypoint: number;
}

export function HeatMap({ heat, onCell }: { heat: Heat; onCell: (cell: Cell | null) => void }) {
  const { take, player, theme, version, select, selected, setSelected } = useShow();
  const canvas = useRef<HTMLCanvasElement>(null);
  const { values, largest, done, what } = heat;
  useEffect(() => {
    if (canvas.current === null || !done) return;
    const columns = Math.min(take.frames, WIDEST);
    drawHeatMap(canvas.current, values, take.keypoints, columns, largest, theme, heatColours(isDark()));
  }, [values, done, largest, theme, take, version]);

  const cellAt = (event: MouseEvent): Cell => {
    const box = (event.currentTarget as HTMLElement).getBoundingClientRect();
    const frame = Math.floor(((event.clientX - box.left) / box.width) * take.frames);
    const keypoint = Math.floor(((event.clientY - box.top) / box.height) * take.keypoints);
    return {
      frame: Math.min(take.frames - 1, Math.max(0, frame)),
      keypoint: Math.min(take.keypoints - 1, Math.max(0, keypoint)),
    };
  };
  const shown = what === ERROR ? "Errors" : "Expected distances from the true places";
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
      <canvas
        ref={canvas}
        role="img"
        aria-label={`${shown} of ${take.keypoints} keypoints over ${take.frames} frames, up to ${limitOf(heat)}`}
      />
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

/** What the colours mean, and which of the two they show. */
export function HeatKey({ heat }: { heat: Heat }) {
  const { what, choose, choices } = heat;
  return (
    <span class="key">
      {choices.length > 1 && (
        <label class="heat-choice">
          <span class="unseen">Colours show</span>
          <select value={what} onChange={(event) => choose(event.currentTarget.value)}>
            <option value={ERROR}>reprojection error</option>
            <option value={DOUBT}>may be off by</option>
          </select>
        </label>
      )}
      0 <i class="ramp" /> {limitOf(heat)}
      {what === ERROR && (
        <>
          <i class="swatch outlier" /> outlier, left out
        </>
      )}
      <i class="swatch unseen-cell" /> {what === ERROR ? "not observed" : "not known"}
    </span>
  );
}

function limitOf({ done, largest, unit }: Heat): string {
  return done ? `${number(largest)}${unit}` : "…";
}

export function cellText({ take }: Show, { values, what, unit }: Heat, { frame, keypoint }: Cell): string {
  const value = values[frame * take.keypoints + keypoint];
  const inferred = "not observed, inferred";
  const error = value === UNSEEN ? inferred : value === LEFT_OUT ? "outlier, left out" : `${number(value)}${unit}`;
  const doubt = Number.isFinite(value)
    ? `may be off by ${number(value, 2)}${unit}`
    : "how far it may be off is not known";
  return `${take.names[keypoint]}, frame ${frame}: ${what === ERROR ? error : doubt}`;
}
