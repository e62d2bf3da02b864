/** Everything that can be taken away: what the API exports, and pictures of the screen. */

import { useState } from "preact/hooks";
import { saveBlob } from "../api/download.ts";
import type { Fit } from "../api/resources.ts";
import { calibrationsOf, downloadsOf } from "../models/downloads.ts";
import { Downloads, type Entry } from "../parts/downloads.tsx";
import { Icon } from "../parts/icons.tsx";
import { filmKind, record } from "./recording.ts";
import type { Stage } from "./scene/scene.ts";
import { useShow } from "./show.ts";
import { fittedOf, hasUnit } from "./unit.ts";

const ANIMATIONS = [
  ["TRC", "trc", ".trc"],
  ["C3D", "c3d", ".c3d"],
  ["BVH", "bvh", ".bvh"],
  ["glTF", "glb", ".glb"],
  ["CSV", "csv", ".csv"],
] as const;

export function Exports({ stage }: { stage: Stage | null }) {
  const { fit, model, cameras, take, query: room, editing } = useShow();
  const [unit, setUnit] = useState(hasUnit(fittedOf(fit, model)) ? "m" : "");
  const [range, setRange] = useState({ first: "", last: "" });
  const { slice, part } = sliceOf(range, take.frames);
  const animations = ANIMATIONS.map(([label, format, suffix]): Entry => {
    const query = `format=${format}${room}${slice}${unit === "" ? "" : `&unit=${unit}`}`;
    return [label, `fits/${fit.id}/animation?${query}`, `${fit.id}${part}${suffix}`];
  });
  return (
    <>
      <Downloads
        groups={[
          [
            "Structures and cameras",
            structuresOf(fit, `${room}${slice}`, part),
            <RangeChoice key="range" range={range} setRange={setRange} frames={take.frames} />,
          ],
          ["Animation, for other tools", animations, <UnitChoice key="unit" unit={unit} setUnit={setUnit} />],
          ...(model === null
            ? [["Cameras, as a calibration", calibrationsOf("fits", fit.id, cameras)] as [string, Entry[]]]
            : downloadsOf(model.id, cameras)),
          ["Capture", capturesOf(fit.dataset_id, editing.list.length > 0)],
        ]}
        hindered={(label) => (label === "TRC" && unit === "" ? "TRC names the unit: choose it" : undefined)}
      />
      {stage !== null && <Pictures stage={stage} />}
    </>
  );
}

/** Returns what can be saved of what the cameras saw. */
function capturesOf(dataset: string, corrected: boolean): Entry[] {
  const path = `datasets/${dataset}/capture`;
  const entries: Entry[] = [["npz", path, `${dataset}.npz`]];
  if (corrected) entries.push(["as detected", `${path}?corrected=false`, `${dataset}-detected.npz`]);
  return entries;
}

/** Returns what can be saved of a fit's structures and cameras: with a query of
 * frames and of a frame of reference, in files whose names have the part. */
export function structuresOf(fit: Fit, query = "", part = ""): Entry[] {
  return ["npz", "safetensors", "json"].map((format) => [
    format,
    `fits/${fit.id}/reconstruction?format=${format}${query}`,
    `${fit.id}${part}.${format}`,
  ]);
}

interface Range {
  first: string; // as they are typed
  last: string;
}

/** Returns the query of a range of frames and what a file of it is called; nothing for all. */
function sliceOf({ first, last }: Range, frames: number): { slice: string; part: string } {
  if (first === "" && last === "") return { slice: "", part: "" };
  const start = Math.min(Math.max(0, Math.round(Number(first))), frames - 1);
  const end = last === "" ? frames - 1 : Math.min(Math.max(start, Math.round(Number(last))), frames - 1);
  return { slice: `&frames=${start}:${end + 1}`, part: `-${start}-${end}` };
}

function RangeChoice({ range, setRange, frames }: { range: Range; setRange: (range: Range) => void; frames: number }) {
  const field = (which: keyof Range, placeholder: number, label: string) => (
    <input
      type="number"
      aria-label={label}
      min={0}
      max={frames - 1}
      placeholder={`${placeholder}`}
      value={range[which]}
      onInput={(event) => setRange({ ...range, [which]: event.currentTarget.value })}
    />
  );
  return (
    <span class="range-choice">
      , frames {field("first", 0, "First frame of the file")} to {field("last", frames - 1, "Last frame of the file")}
    </span>
  );
}

/** The unit of the lengths that the fit was given, which nobody states but who gave them. */
function UnitChoice({ unit, setUnit }: { unit: string; setUnit: (unit: string) => void }) {
  return (
    <label>
      , its unit
      <select value={unit} onChange={(event) => setUnit(event.currentTarget.value)}>
        <option value="">unknown</option>
        <option value="m">m</option>
        <option value="mm">mm</option>
      </select>
    </label>
  );
}

function Pictures({ stage }: { stage: Stage }) {
  const { fit, player } = useShow();
  const kind = filmKind();
  const [stop, setStop] = useState<(() => void) | null>(null);
  const start = () => {
    const stopping = record(stage.canvas, player, (film) => {
      setStop(null);
      saveBlob(film, `${fit.id}${kind.suffix}`);
    });
    setStop(() => stopping);
  };
  return (
    <div class="exports">
      <span>What the 3D view shows</span>
      <span class="buttons">
        <button
          onClick={() =>
            stage.canvas.toBlob((picture) => picture && saveBlob(picture, `${fit.id}-${player.frame}.png`))
          }
        >
          <Icon name="picture" /> PNG
        </button>
        <button onClick={stop ?? start} aria-pressed={stop !== null}>
          <Icon name="film" /> {stop === null ? `${kind.name}, all frames` : "Stop recording"}
        </button>
      </span>
    </div>
  );
}
