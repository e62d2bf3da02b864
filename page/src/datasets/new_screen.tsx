/** A new capture: files are dropped, looked at, described, stored. */

import { useEffect, useRef, useState } from "preact/hooks";
import { captured } from "../fits/fits_screen.tsx";
import { Alert } from "../parts/alert.tsx";
import { bytes, count, percent } from "../parts/format.ts";
import { Icon } from "../parts/icons.tsx";
import { goTo } from "../route.ts";
import { filesOf, sorted } from "./dropping.ts";
import { Understood } from "./understood.tsx";
import { recall } from "./unfinished.ts";
import { upload, type Description } from "./upload.ts";
import { useLook, type Look } from "./use_look.ts";

const NOTHING: Description = { name: "", fps: "", width: "", height: "" };

export function NewScreen() {
  const [files, setFiles] = useState<File[]>([]);
  const [description, setDescription] = useState(NOTHING);
  const [sent, setSent] = useState<number | null>(null); // share of what is being stored
  const [broken, setBroken] = useState<string | null>(null); // why nothing is sent just now
  const [trouble, setTrouble] = useState<string | null>(null);
  const stop = useRef<AbortController | null>(null);
  const look = useLook(files, description);
  useEffect(() => {
    document.title = "New capture · Fewview";
    return () => stop.current?.abort();
  }, []);

  const unfinished = files.length === 1 && files.every((file) => recall(file) !== null);
  const take = (found: File[]) => {
    setTrouble(null);
    setFiles(sorted([...files.filter((file) => !found.some((other) => other.name === file.name)), ...found]));
    if (description.name === "" && found.length > 0) setDescription({ ...description, name: nameFor(found) });
  };
  const store = async (event: Event) => {
    event.preventDefault();
    setTrouble(null);
    setSent(0);
    stop.current = new AbortController();
    try {
      const watching = { onProgress: setSent, onBreak: setBroken, signal: stop.current.signal };
      const dataset = await upload(files, description, watching);
      goTo("datasets", dataset.id);
    } catch (error) {
      setTrouble((error as Error).message);
      setSent(null);
      setBroken(null);
    }
  };
  return (
    <main>
      <header class="title">
        <h1>New capture</h1>
      </header>
      <form onSubmit={(event) => void store(event)}>
        <DropZone onFiles={take} />
        {files.length > 0 && (
          <FileList files={files} onRemove={(gone) => setFiles(files.filter((file) => file !== gone))} />
        )}
        <Fields description={description} setDescription={setDescription} disabled={sent !== null} />
        <Looked look={look} />
        <Alert>{trouble}</Alert>
        {sent === null ? (
          <button class="primary" disabled={look.state !== "seen"}>
            {unfinished ? "Store what is missing of it" : "Store this capture"}
          </button>
        ) : (
          <Sending share={sent} then="Storing …" broken={broken} onStop={() => stop.current?.abort()} />
        )}
      </form>
    </main>
  );
}

function Looked({ look }: { look: Look }) {
  if (look.state === "none") return null;
  if (look.state === "refused") return <Alert>{look.reason}</Alert>;
  if (look.state === "sending") return <Sending share={look.share} then="Reading the files …" />;
  const { preview } = look;
  return (
    <section class="panel" aria-label="What was understood">
      <h2>
        What was understood <span class="quiet">{captured(preview)}. Nothing is stored yet.</span>
      </h2>
      <Understood facts={preview} frame={look.drawn} />
    </section>
  );
}

interface SendingProps {
  share: number;
  then: string;
  broken?: string | null;
  onStop?: () => void;
}

function Sending({ share, then, broken = null, onStop }: SendingProps) {
  return (
    <div class="sending">
      <progress max={1} value={share} aria-label="Upload" />
      <span class="quiet" role="status">
        {broken !== null ? `${broken} Trying again.` : share < 1 ? `${percent(share)} sent` : then}
      </span>
      {onStop && (
        <button type="button" onClick={onStop}>
          Stop
        </button>
      )}
    </div>
  );
}

interface FieldsProps {
  description: Description;
  setDescription: (description: Description) => void;
  disabled: boolean;
}

function Fields({ description, setDescription, disabled }: FieldsProps) {
  const set = (change: Partial<Description>) => setDescription({ ...description, ...change });
  return (
    <fieldset class="fields" disabled={disabled}>
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
  const [first = ""] = names;
  let shared = first;
  for (const name of names) while (!name.startsWith(shared)) shared = shared.slice(0, -1);
  return shared.replace(/[\s_\-.]*(cam(era)?|view)?[\s_\-.]*$/i, "") || first;
}
