/** What of a model can be taken away. */

import type { ModelCameras } from "../api/resources.ts";
import type { Entry } from "../parts/downloads.tsx";

/** Returns what can be saved, under titles. */
export function downloadsOf(id: string, cameras: ModelCameras | null): [string, Entry[]][] {
  const of = (kind: string) => `models/${id}/${kind}`;
  const calibrations: Entry[] = [
    ["JSON", of("cameras"), `${id}-cameras.json`],
    ["Anipose", of("cameras?format=anipose"), `${id}.toml`],
    ["OpenCV", of("cameras?format=opencv"), `${id}.yaml`],
    ["COLMAP", of("cameras?format=colmap"), `${id}-colmap.zip`],
  ];
  return [
    ["Cameras, as a calibration", cameras === null || cameras.views.length === 0 ? [] : calibrations],
    [
      "Model",
      [
        ["weights", of("weights"), `${id}.safetensors`],
        ["ONNX", of("network"), `${id}.onnx`],
      ],
    ],
  ];
}
