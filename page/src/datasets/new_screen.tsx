/** A new capture: files are dropped, described, sent. */

import { useEffect, useRef, useState } from "preact/hooks";
import { bytes, count, percent } from "../parts/format.ts";
import { Icon } from "../parts/icons.tsx";
import { goTo } from "../route.ts";
import { filesOf, sorted } from "./dropping.ts";
import { upload, type Description } from "./upload.ts";

const NOTHING: Description = { name: "", fps: "", width: "", height: "" };

export function NewScreen() {
  const [files, setFiles] = useState<File[]>([]);
  const [description, setDescription] = useState(NOTHING);
  const [sent, setSent] = useState<number | null>(null); // share
  const [trouble, setTrouble] = useState<string | null>(null);
  const stop = useRef<AbortController | null>(null);
  useEffect(() => {
    document.title = "New capture · Fewview";
    return () => stop.current?.abort();
  }, []);

  const take = (found: File[]) => {
    setTrouble(null);
    setFiles(sorted([...files.filter((file) => !found.some((other) => other.name === file.name)), ...found]));
    if (description.name === "" && found.length > 0) setDescription({ ...description, name: nameFor(found) });
  };
  const send = async (event: Event) => {
    event.preventDefault();
    setTrouble(null);
    setSent(0);
    stop.current = new AbortController();
    try {
      const dataset = await upload(files, description, setSent, stop.current.signal);
      goTo("datasets", dataset.id);
    } catch (error) {
      setTrouble((error as Error).message);
      setSent(null);
    }
  };
  const set = (change: Partial<Description>) => setDescription({ ...description, ...change });
  return (
    <main>
      <header class="title">
        <h1>New capture</h1>
      </header>
      <form onSubmit={(event) => void send(event)}>
        <DropZone onFiles={take} />
        {files.length > 0 && <FileList files={files} onRemove={(gone) => setFiles(files.filter((file) => file !== gone))} />}
        <fieldset class="fields" disabled={sent !== null}>
          <label>
            Name
            <input value={description.name} maxLength={200} onInput={(event) => set({ name: event.currentTarget.value })} />
          </label>
          <label>
            Frames per second <small class="quiet">if known: late views are then put in step</small>
            <input
              type="number"
              min={0.01}
              step="any"
              value={description.fps}
              onInput={(event) => set({ fps: event.currentTarget.value })}
            />
          </label>
          <div class="pair">
            <label>
              Image width <small class="quiet">px, if those of all files are alike</small>
              <input
                type="number"
                min={1}
                value={description.width}
                onInput={(event) => set({ width: event.currentTarget.value })}
              />
            </label>
            <label>
              height <small class="quiet">px</small>
              <input
                type="number"
                min={1}
                value={description.height}
                onInput={(event) => set({ height: event.currentTarget.value })}
              />
            </label>
          </div>
        </fieldset>
        {trouble !== null && (
          <p class="trouble" role="alert">
            {trouble}
          </p>
        )}
        {sent === null ? (
          <button class="primary" disabled={files.length === 0}>
            Upload
          </button>
        ) : (
          <div class="sending">
            <progress max={1} value={sent} aria-label="Upload" />
            <span class="quiet">{sent < 1 ? `${percent(sent)} sent` : "Reading the files …"}</span>
            <button type="button" onClick={() => stop.current?.abort()}>
              Stop
            </button>
          </div>
        )}
      </form>
    </main>
  );
}

function DropZone({ onFiles }: { onFiles: (files: File[]) => void }) {
  const [over, setOver] = useState(false);
  return (
    <label
      class={`drop${over ? " over" : ""}`}
      onDragOver={(event) => {
        event.preventDefault();
        setOver(true);
      }}
      onDragLeave={() => setOver(false)}
      onDrop={(event) => {
        event.preventDefault();
        setOver(false);
        if (event.dataTransfer) void filesOf(event.dataTransfer).then(onFiles);
      }}
    >
      <input type="file" multiple onChange={(event) => onFiles([...(event.currentTarget.files ?? [])])} />
      <Icon name="file" />
      <strong>Drop a file for each camera here, or choose them</strong>
      <span class="quiet">
        What DeepLabCut, SLEAP, OpenPose, COCO, MMPose and others write: CSV, H5, JSON, or a zip of a folder of JSON. Or
        one .npz or .safetensors with an array <code>keypoints</code> (frames, views, keypoints, 2).
      </span>
    </label>
  );
}

function FileList({ files, onRemove }: { files: File[]; onRemove: (file: File) => void }) {
  return (
    <ul class="files" aria-label="Files to send">
      {files.map((file) => (
        <li key={file.name}>
          <span>{file.name}</span>
          <span class="quiet">{bytes(file.size)}</span>
          <button type="button" class="icons" aria-label={`Leave out ${file.name}`} onClick={() => onRemove(file)}>
            <Icon name="close" />
          </button>
        </li>
      ))}
      <li class="quiet">{count(files.length, "file")}, a view each, in this order</li>
    </ul>
  );
}

/** Returns a name for a capture: what the names of its files have in common. */
function nameFor(files: File[]): string {
  const names = files.map((file) => file.name.replace(/\.[^.]*$/, ""));
  let shared = names[0];
  for (const name of names) while (!name.startsWith(shared)) shared = shared.slice(0, -1);
  return shared.replace(/[\s_\-.]*(cam(era)?|view)?[\s_\-.]*$/i, "") || names[0];
}
