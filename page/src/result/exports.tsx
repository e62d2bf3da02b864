/** Everything that can be taken away: what the API exports, and pictures of the screen. */

import { useState } from "preact/hooks";
import { download, saveBlob } from "../api/download.ts";
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

type Entry = [label: string, path: string, file: string];

export function Exports({ stage }: { stage: Stage | null }) {
  const { fit, model, cameras, take } = useShow();
  const [trouble, setTrouble] = useState<string | null>(null);
  const [unit, setUnit] = useState(hasUnit(model.config) ? "m" : "");
  const room = { level: "&frame=room&up=auto", camera: "&frame=room", view: "" }[take.frame];
  const structures = (format: string, suffix: string): Entry => [
    suffix,
    `fits/${fit.id}/reconstruction?format=${format}${room}`,
    `${fit.id}.${suffix}`,
  ];
  const of = (kind: string) => `models/${model.id}/${kind}`;
  const groups: [string, Entry[]][] = [
    ["Structures and cameras of every frame", [structures("npz", "npz"), structures("safetensors", "safetensors"), structures("json", "json")]],
    [
      "Animation, for other tools",
      ANIMATIONS.map(([label, format, suffix]) => [
        label,
        `fits/${fit.id}/animation?format=${format}${room}${unit === "" ? "" : `&unit=${unit}`}`,
        `${fit.id}${suffix}`,
      ]),
    ],
    [
      "Cameras, as a calibration",
      cameras.views.length === 0
        ? []
        : [
            ["JSON", of("cameras"), `${model.id}-cameras.json`],
            ["Anipose", of("cameras?format=anipose"), `${model.id}.toml`],
            ["OpenCV", of("cameras?format=opencv"), `${model.id}.yaml`],
            ["COLMAP", of("cameras?format=colmap"), `${model.id}-colmap.zip`],
          ],
    ],
    [
      "Model",
      [
        ["weights", of("weights"), `${model.id}.safetensors`],
        ["ONNX", of("network"), `${model.id}.onnx`],
      ],
    ],
    ["Capture, as it was uploaded", [["npz", `datasets/${fit.dataset_id}/capture`, `${fit.dataset_id}.npz`]]],
  ];
  return (
    <>
      {groups.map(([title, entries]) =>
        entries.length === 0 ? null : (
          <div class="exports" key={title}>
            <span>
              {title}
              {title.startsWith("Animation") && <UnitChoice unit={unit} setUnit={setUnit} />}
            </span>
            <span class="buttons">
              {entries.map(([label, path, file]) => (
                <button
                  key={label}
                  disabled={label === "TRC" && unit === ""}
                  title={label === "TRC" && unit === "" ? "TRC names the unit: choose it" : undefined}
                  onClick={() => {
                    setTrouble(null);
                    download(path, file).catch((error: Error) => setTrouble(error.message));
                  }}
                >
                  <Icon name="save" /> {label}
                </button>
              ))}
            </span>
          </div>
        ),
      )}
      {stage !== null && <Pictures stage={stage} />}
      {trouble !== null && (
        <p class="trouble" role="alert">
          {trouble}
        </p>
      )}
    </>
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
