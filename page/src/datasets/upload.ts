/** Sends files with a progress that can be seen, which `fetch` does not give. */

import { addressOf, keyHeader, refusalOf, Refusal } from "../api/http.ts";
import type { Dataset, DatasetPreview } from "../api/resources.ts";

export interface Description {
  name: string;
  fps: string; // as it was typed; empty if nobody knows
  width: string;
  height: string;
}

const ARRAYS = /\.(npz|safetensors)$/i;

/** Returns the dataset that files became; throws `Refusal` with the service's words. */
export function upload(...sent: Sent): Promise<Dataset> {
  return send<Dataset>("datasets", ...sent);
}

/** Returns what is understood of files, of which nothing is stored. */
export function lookAt(...sent: Sent): Promise<DatasetPreview> {
  return send<DatasetPreview>("previews", ...sent);
}

type Sent = [files: File[], description: Description, onProgress: (share: number) => void, signal: AbortSignal];

function send<T>(path: string, ...[files, description, onProgress, signal]: Sent): Promise<T> {
  const request = new XMLHttpRequest();
  return new Promise((resolve, reject) => {
    request.upload.onprogress = (event) => onProgress(event.lengthComputable ? event.loaded / event.total : 0);
    request.onload = () => {
      if (request.status < 300) resolve(JSON.parse(request.responseText) as T);
      else reject(refusalOf(request.status, request.responseText));
    };
    request.onerror = () => reject(new Refusal(0, { detail: "The connection broke. Try again." }));
    request.onabort = () => reject(new Refusal(0, { detail: "The upload was stopped." }));
    signal.addEventListener("abort", () => request.abort());
    request.open("POST", addressOf(path));
    for (const [name, value] of Object.entries(keyHeader())) request.setRequestHeader(name, value);
    request.send(formOf(files, description));
  });
}

function formOf(files: File[], { name, fps, width, height }: Description): FormData {
  const form = new FormData();
  const arrays = files.length === 1 && ARRAYS.test(files[0].name);
  for (const file of files) form.append(arrays ? "file" : "files", file, file.name);
  if (name !== "") form.append("name", name);
  if (fps !== "") form.append("fps", fps);
  if (width !== "" && height !== "" && !arrays) {
    const size = [Number(width), Number(height)];
    form.append("image_sizes", JSON.stringify(files.map(() => size)));
  }
  return form;
}
