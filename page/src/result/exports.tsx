/** Everything that can be taken away: what the API exports, and pictures of the screen. */

import { useState } from "preact/hooks";
import { saveBlob } from "../api/download.ts";
import type { Fit } from "../api/resources.ts";
import { downloadsOf } from "../models/downloads.ts";
import { Downloads, type Entry } from "../parts/downloads.tsx";
import { Icon } from "../parts/icons.tsx";
import { record } from "./recording.ts";
import type { Stage } from "./scene/scene.ts";
import { useShow } from "./show.ts";
import { hasUnit } from "./unit.ts";

const ANIMATIONS = [
  ["TRC", "trc", ".trc"],
  ["C3D", "c3d", ".c3d"],
  ["BVH", "bvh", ".bvh"],
  ["glTF", "glb", ".glb"],
  ["CSV", "csv", ".csv"],
] as const;

export function Exports({ stage }: { stage: Stage | null }) {
  const { fit, model, cameras, take } = useShow();
  const [unit, setUnit] = useState(hasUnit(model.config) ? "m" : "");
  const room = { level: "&frame=room&up=auto", camera: "&frame=room", view: "" }[take.frame];
  const animations = ANIMATIONS.map(([label, format, suffix]): Entry => {
    const query = `format=${format}${room}${unit === "" ? "" : `&unit=${unit}`}`;
    return [label, `fits/${fit.id}/animation?${query}`, `${fit.id}${suffix}`];
  });
  return (
    <>
      <Downloads
        groups={[
          ["Structures and cameras of every frame", structuresOf(fit, room)],
          ["Animation, for other tools", animations, <UnitChoice key="unit" unit={unit} setUnit={setUnit} />],
          ...downloadsOf(model.id, cameras),
          ["Capture, as it was uploaded", [["npz", `datasets/${fit.dataset_id}/capture`, `${fit.dataset_id}.npz`]]],
        ]}
        hindered={(label) => (label === "TRC" && unit === "" ? "TRC names the unit: choose it" : undefined)}
      />
      {stage !== null && <Pictures stage={stage} />}
    </>
  );
}

/** Returns what can be saved of a fit's structures and cameras, in a frame of reference. */
export function structuresOf(fit: Fit, frame = ""): Entry[] {
  return ["npz", "safetensors", "json"].map((format) => [
    format,
    `fits/${fit.id}/reconstruction?format=${format}${frame}`,
    `${fit.id}.${format}`,
  ]);
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
  const [stop, setStop] = useState<(() => void) | null>(null);
  const start = () => {
    const stopping = record(stage.canvas, player, (film) => {
      setStop(null);
      saveBlob(film, `${fit.id}.webm`);
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
          <Icon name="film" /> {stop === null ? "WebM, all frames" : "Stop recording"}
        </button>
      </span>
    </div>
  );
}
