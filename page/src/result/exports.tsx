/** Everything that can be taken away: what the API exports, and pictures of the screen. */

import { useState } from "preact/hooks";
import { download, saveBlob } from "../api/download.ts";
import { Icon } from "../parts/icons.tsx";
import { record } from "./recording.ts";
import type { Stage } from "./scene/scene.ts";
import { useShow } from "./show.ts";

type Entry = [label: string, path: string, file: string];

export function Exports({ stage }: { stage: Stage | null }) {
  const { fit, model, cameras, take } = useShow();
  const [trouble, setTrouble] = useState<string | null>(null);
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
            <span>{title}</span>
            <span class="buttons">
              {entries.map(([label, path, file]) => (
                <button
                  key={label}
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
