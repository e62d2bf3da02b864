/** What of a model can be taken away. */

import type { ModelCameras } from "../api/resources.ts";
import type { Entry } from "../parts/downloads.tsx";

/** Returns calibration files of the cameras of a model or a fit. */
export function calibrationsOf(
  kind: "models" | "fits",
  id: string,
  cameras: Pick<ModelCameras, "views"> | null,
): Entry[] {
  if (cameras === null || cameras.views.length === 0) return [];
  const path = `${kind}/${id}/cameras`;
  return [
    ["JSON", path, `${id}-cameras.json`],
    ["Anipose", `${path}?format=anipose`, `${id}.toml`],
    ["OpenCV", `${path}?format=opencv`, `${id}.yaml`],
    ["COLMAP", `${path}?format=colmap`, `${id}-colmap.zip`],
  ];
}

/** Returns what can be saved, under titles. */
export function downloadsOf(id: string, cameras: Pick<ModelCameras, "views"> | null): [string, Entry[]][] {
  const of = (kind: string) => `models/${id}/${kind}`;
  return [
    ["Cameras, as a calibration", calibrationsOf("models", id, cameras)],
    [
      "Model",
      [
        ["weights", of("weights"), `${id}.safetensors`],
        ["ONNX", of("network"), `${id}.onnx`],
      ],
    ],
  ];
}
