/** Curves over all frames, along which one seeks; and a file of what is shown. */

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type uPlot from "uplot";
import { saveBlob } from "../../api/download.ts";
import { secondsOf } from "../../data/capture.ts";
import { csvOf } from "../../parts/csv.ts";
import { number } from "../../parts/format.ts";
import { Icon } from "../../parts/icons.tsx";
import { Plot } from "../../parts/plot.tsx";
import { useShow } from "../show.ts";
import { curveGroups, type Curves } from "./curve_choice.ts";

export function CurvePanel() {
  const { take, unit, selected } = useShow();
  const [chosen, setChosen] = useState("");
  const times = useMemo(() => secondsOf(take), [take]);
  const groups = useMemo(() => curveGroups(take, selected, unit, times), [take, selected, unit, times]);
  const curves = groups.flatMap((group) => group.curves).find(({ id }) => id === chosen);
  return (
    <>
      <label class="curve-choice">
        Curve over time{" "}
        <select
          value={curves === undefined ? "" : chosen}
          onChange={(event) => setChosen(event.currentTarget.value)}
          disabled={groups.length === 0}
        >
          <option value="">{groups.length === 0 ? "select a keypoint first" : "none"}</option>
          {groups.map((group) => (
            <optgroup key={group.label} label={group.label}>
              {group.curves.map(({ id, label }) => (
                <option key={id} value={id}>
                  {label}
                </option>
              ))}
            </optgroup>
          ))}
        </select>
      </label>
      {curves !== undefined && <Drawn curves={curves} times={times} />}
    </>
  );
}

function Drawn({ curves, times }: { curves: Curves; times: Float64Array | null }) {
  const { fit, take, player, loop, version, done } = useShow();
  // eslint-disable-next-line react-hooks/exhaustive-deps -- the version is of what the take's arrays hold
  const values = useMemo(() => curves.series.map((series) => series.values()), [curves, version]);
  const frames = useMemo(() => Float64Array.from({ length: take.frames }, (_, frame) => frame), [take]);
  const x = times ?? frames;
  const data = useMemo((): uPlot.AlignedData => [x, ...values.map(withGaps)], [x, values]);
  const legend = useRef<HTMLUListElement>(null);
  const linked = useLinkedPlot(x);
  useEffect(
    () =>
      loop.add(() => {
        curves.series.forEach((_, index) => {
          const place = legend.current?.children[index]?.querySelector("output");
          if (place) place.textContent = number(values[index]?.[player.frame]);
        });
      }),
    [loop, player, values, curves],
  );
  const save = () => {
    const seconds = times === null ? [] : [{ name: "seconds", values: times }];
    const columns = curves.series.map(({ name }, index) => ({
      name: `${name} (${curves.unit})`,
      values: values[index] ?? [],
    }));
    const text = csvOf([{ name: "frame", values: frames }, ...seconds, ...columns]);
    saveBlob(new Blob([text], { type: "text/csv" }), `${fit.id}-${curves.id.replaceAll(" ", "-")}.csv`);
  };
  return (
    <div class="curves">
      <Plot
        data={data}
        height={190}
        x={times === null ? "frame" : "seconds"}
        y={curves.unit}
        scales={{ x: { time: false }, y: {} }}
        series={(theme) =>
          curves.series.map(({ colour }) => ({ stroke: theme[colour], width: 1.5, points: { show: false } }))
        }
        summary={summaryOf(curves, values)}
        anew={curves.series.map(({ name }) => name).join("\n")}
        onPlot={linked}
      />
      <ul class="curve-legend" ref={legend}>
        {curves.series.map(({ name, colour }) => (
          <li key={name}>
            <i class="stroke" style={{ background: `var(--${colour})` }} /> {name} <output />
          </li>
        ))}
        <li class="last">
          <button onClick={save} disabled={!done} title={done ? "" : "not all frames have come yet"}>
            <Icon name="save" /> CSV of the curve
          </button>
        </li>
      </ul>
      {!done && <p class="quiet">The curve fills as frames come.</p>}
      {take.frame === "view" && curves.unit !== "degrees" && (
        <p class="quiet">No camera is known to be static: each frame is in the axes of its first view.</p>
      )}
    </div>
  );
}

/** Links a plot with the player: a line shows the frame, and a press or drag goes to one.
 *
 * @param x (N,) where frames are along the plot */
function useLinkedPlot(x: Float64Array): (plot: uPlot) => void {
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

function withGaps(values: Float64Array): (number | null)[] {
  return Array.from(values, (value) => (Number.isNaN(value) ? null : value));
}

function summaryOf({ label, unit, series }: Curves, values: Float64Array[]): string {
  const ranges = series.map(({ name }, index) => {
    let [low, high] = [Infinity, -Infinity];
    for (const value of values[index] ?? []) {
      if (value < low) low = value; // false for NaN
      if (value > high) high = value;
    }
    return `${name} from ${number(low)} to ${number(high)}`;
  });
  return `${label}, ${unit}: ${ranges.join("; ")}`;
}
