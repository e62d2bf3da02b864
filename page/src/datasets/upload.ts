/** Sends files with a progress that can be seen, which `fetch` does not give, and goes on after a
 * break: nothing is stored twice, and of a long file of arrays nothing is sent twice. */

import { addressOf, keyHeader, refusalOf, Refusal } from "../api/http.ts";
import { getDataset, type Dataset, type DatasetPreview } from "../api/resources.ts";
import { unique } from "../parts/unique.ts";
import type { Reading } from "../remedies/reading.tsx";
import { groupsOf, type Placed } from "./dropping.ts";
import { arePacked, packed } from "./folders.ts";
import { partsOf, type Parts } from "./parts.ts";
import { forget, recall, remember } from "./unfinished.ts";
import type { WantedView } from "./views.tsx";

export interface Description {
  name: string;
  fps: string; // as it was typed; empty if nobody knows
  width: string;
  height: string;
  person: string; // one for each view, with commas; empty: found out
  views: WantedView[] | null; // null: all that there are
  reading: Reading; // of files that are no arrays
}

export interface Watching {
  onProgress(share: number): void;
  /** Called when the connection broke, and with null when it is there again. */
  onBreak(reason: string | null): void;
  signal: AbortSignal;
}

const ARRAYS = /\.(npz|safetensors)$/i;
const AGAIN_MS = 1000; // after the connection broke
const STOPPED = "The upload was stopped.";

/** Returns the dataset that files became; throws `Refusal` with the service's words. */
export async function upload(files: Placed[], description: Description, watching: Watching): Promise<Dataset> {
  const file = arraysIn(files);
  const parts = file && (await partsOf(file));
  if (file !== null && parts !== null) return uploadInParts(file, parts, description, watching);
  const key = unique();
  const form = await formOf(files, description);
  if (description.views !== null && arraysIn(files) === null) {
    form.append("view_names", JSON.stringify(description.views.map(({ name, source }) => name || source)));
  }
  return persisting(watching, () => send<Dataset>("datasets", form, watching, key));
}

/** Returns what is understood of files, of which nothing is stored: of a long file its first part. */
export async function lookAt(files: Placed[], description: Description, watching: Watching): Promise<DatasetPreview> {
  const file = arraysIn(files);
  const parts = file && (await partsOf(file));
  if (file === null || parts === null) {
    return send<DatasetPreview>("previews", await formOf(files, description), watching);
  }
  const seen = await send<DatasetPreview>("previews", firstOf(parts, file, description), watching);
  const notes = [...seen.notes, `looked at the first ${parts.size} of ${parts.frames} frames`];
  return { ...seen, frames: parts.frames, notes };
}

async function uploadInParts(file: File, parts: Parts, description: Description, watching: Watching): Promise<Dataset> {
  const share = (frames: number) => watching.onProgress(frames / parts.frames);
  const key = unique();
  const found = await begunBefore(file, watching);
  let dataset =
    found ??
    (await persisting(watching, () =>
      send<Dataset>("datasets", firstOf(parts, file, description), { ...watching, onProgress: () => {} }, key),
    ));
  remember(file, dataset.id);
  while (dataset.frames < parts.frames) {
    const first = dataset.frames;
    const end = Math.min(parts.frames, first + parts.size);
    share(first);
    const path = `datasets/${encodeURIComponent(dataset.id)}/frames`;
    const onProgress = (sent: number) => share(first + sent * (end - first));
    const body = parts.part(first, end);
    dataset = await persisting(watching, () =>
      send<Dataset>(path, body, { ...watching, onProgress }, `${dataset.id}-${first}`),
    );
  }
  forget(file);
  return dataset;
}

/** Returns the dataset that a part of a file is in, from another time. */
async function begunBefore(file: File, watching: Watching): Promise<Dataset | null> {
  const id = recall(file);
  if (id === null) return null;
  try {
    return await persisting(watching, () => getDataset(id));
  } catch {
    return null; // it was deleted
  }
}

/** Does something again until the service answers. */
async function persisting<T>({ signal, onBreak }: Watching, act: () => Promise<T>): Promise<T> {
  for (;;) {
    try {
      const done = await act();
      onBreak(null);
      return done;
    } catch (error) {
      const broken = error instanceof Refusal && (error.status === 0 || error.status === 503);
      if (!broken || signal.aborted) throw error;
      onBreak(error.message);
      await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
      if (signal.aborted) throw new Refusal(0, { detail: STOPPED });
    }
  }
}

function send<T>(path: string, body: FormData | Blob, { onProgress, signal }: Watching, key?: string): Promise<T> {
  const request = new XMLHttpRequest();
  return new Promise((resolve, reject) => {
    request.upload.onprogress = (event) => onProgress(event.lengthComputable ? event.loaded / event.total : 0);
    request.onload = () => {
      if (request.status < 300) resolve(JSON.parse(request.responseText) as T);
      else reject(refusalOf(request.status, request.responseText));
    };
    request.onerror = () => reject(new Refusal(0, { detail: "The connection broke." }));
    request.onabort = () => reject(new Refusal(0, { detail: STOPPED }));
    signal.addEventListener("abort", () => request.abort());
    request.open("POST", addressOf(path));
    for (const [name, value] of Object.entries(keyHeader())) request.setRequestHeader(name, value);
    if (key !== undefined) request.setRequestHeader("Idempotency-Key", key);
    if (body instanceof Blob) request.setRequestHeader("Content-Type", "application/octet-stream");
    request.send(body);
  });
}

/** Returns the file that holds arrays of all views, if there is nothing else. */
export function arraysIn(files: Placed[]): File | null {
  const [placed, ...more] = files;
  const arrays = placed !== undefined && more.length === 0 && ARRAYS.test(placed.path) && !arePacked(files);
  return arrays ? placed.file : null;
}

async function formOf(files: Placed[], description: Description): Promise<FormData> {
  const { name, fps, width, height, person, views, reading } = description;
  const form = new FormData();
  const arrays = arraysIn(files) !== null;
  if (arePacked(files)) form.append("folders", await packed(files), "folders.zip");
  else for (const { path, file } of files) form.append(arrays ? "file" : "files", file, path);
  if (person !== "" && !reading.person && !arrays) form.append("person", person);
  if (views !== null && !reading.cameras && !arrays)
    form.append("cameras", views.map(({ source }) => source).join(","));
  if (name !== "") form.append("name", name);
  if (fps !== "") form.append("fps", fps);
  for (const [option, text] of Object.entries(reading)) if (text !== "" && !arrays) form.append(option, text);
  if (width !== "" && height !== "" && !arrays) {
    const size = [Number(width), Number(height)];
    form.append("image_sizes", JSON.stringify((views ?? groupsOf(files)).map(() => size)));
  }
  return form;
}

/** Returns the form of the first part of a file, with what the file has of all its frames. */
function firstOf(parts: Parts, file: File, { name, fps }: Description): FormData {
  const form = new FormData();
  const end = Math.min(parts.size, parts.frames);
  form.append("file", parts.part(0, end), `${file.name}.safetensors`);
  const fields = { ...parts.description, ...(name !== "" && { name }), ...(fps !== "" && { fps }) };
  for (const [field, value] of Object.entries(fields)) form.append(field, value);
  return form;
}
