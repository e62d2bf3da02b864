/** Curves over all frames, along which one seeks; and a file of what is shown. */

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { saveBlob } from "../../api/download.ts";
import { secondsOf } from "../../data/capture.ts";
import { csvOf } from "../../parts/csv.ts";
import { plusMinus } from "../../parts/format.ts";
import { Icon } from "../../parts/icons.tsx";
import { useShow } from "../show.ts";
import type { KnownCovariances } from "../use_covariances.ts";
import { curveGroups, type Curves } from "./curve_choice.ts";
import { Pane, type Line } from "./pane.tsx";

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
  const { fit, take, player, loop, version, done, covariances } = useShow();
  const { series, unit } = curves;
  const { known, coming, ask } = covariances;
  const banded = series.some(({ deviations }) => deviations !== null);
  useEffect(() => (banded ? ask() : undefined), [banded, ask]);
  const lines = useMemo(
    () =>
      series.map(({ name, colour, values, deviations }): Line => {
        return { name, colour, values: values(), deviations: deviations?.(known) ?? null };
      }),
    // eslint-disable-next-line react-hooks/exhaustive-deps -- the version is of what the take's arrays hold
    [series, version, known],
  );
  const frames = useMemo(() => Float64Array.from({ length: take.frames }, (_, frame) => frame), [take]);
  const legend = useRef<HTMLUListElement>(null);
  useEffect(
    () =>
      loop.add(() => {
        lines.forEach(({ values, deviations }, index) => {
          const place = legend.current?.children[index]?.querySelector("output");
          if (!place) return;
          const sign = unit === "degrees" ? "°" : "";
          place.textContent = plusMinus(values[player.frame], deviations?.[player.frame], sign);
        });
      }),
    [loop, player, lines, unit],
  );
  const save = () => {
    const seconds = times === null ? [] : [{ name: "seconds", values: times }];
    const columns = lines.flatMap(({ name, values, deviations }) => [
      { name: `${name} (${unit})`, values },
      ...(isKnown(deviations) ? [{ name: `${name} sd (${unit})`, values: deviations }] : []),
    ]);
    const text = csvOf([{ name: "frame", values: frames }, ...seconds, ...columns]);
    saveBlob(new Blob([text], { type: "text/csv" }), `${fit.id}-${curves.id.replaceAll(" ", "-")}.csv`);
  };
  const panes = curves.apart ? lines.map((line) => [line]) : [lines];
  return (
    <div class="curves">
      <p class="quiet unit">{unit}</p>
      {panes.map((shown, index) => (
        <Pane
          key={index}
          curves={curves}
          lines={shown}
          y={curves.apart?.[index] ?? null}
          x={times ?? frames}
          name={index + 1 < panes.length ? null : times === null ? "frame" : "seconds"}
        />
      ))}
      <ul class="curve-legend" ref={legend}>
        {series.map(({ name, colour }) => (
          <li key={name}>
            <i class="stroke" style={{ background: `var(--${colour})` }} /> {name} <output />
          </li>
        ))}
        <li class="last">
          <button
            onClick={save}
            disabled={!done || coming}
            title={done && !coming ? "" : "not all numbers have come yet"}
          >
            <Icon name="save" /> CSV of the curve
          </button>
        </li>
      </ul>
      {!done && <p class="quiet">The curve fills as frames come.</p>}
      <p class="quiet">{aboutBand(curves, lines, covariances)}</p>
      {take.frame === "view" && unit !== "degrees" && (
        <p class="quiet">No camera is known to be static: each frame is in the axes of its first view.</p>
      )}
    </div>
  );
}

function isKnown(deviations: Float64Array | null): deviations is Float64Array {
  return deviations?.some(Number.isFinite) ?? false;
}

function aboutBand({ id }: Curves, lines: Line[], { coming, trouble }: KnownCovariances): string {
  if (lines.some(({ deviations }) => isKnown(deviations))) {
    return "The band is one standard deviation to either side: how far this may be off.";
  }
  if (id === "speed") return "No band: errors of neighbouring frames are alike, so that of a speed is not known.";
  if (coming) return "How far this may be off is being computed …";
  return `No band: how far this may be off is not known. ${trouble ?? ""}`;
}
