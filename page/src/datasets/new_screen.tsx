/** A new capture: files are dropped, looked at, described, stored. */

import { useEffect, useRef, useState } from "preact/hooks";
import { captured } from "../fits/fits_screen.tsx";
import { Alert } from "../parts/alert.tsx";
import { bytes, count, percent } from "../parts/format.ts";
import { Icon } from "../parts/icons.tsx";
import { ReadingControls, readingInAddress, type Reading } from "../remedies/reading.tsx";
import { goTo } from "../route.ts";
import { chosen, filesOf, groupsOf, joined, type Placed } from "./dropping.ts";
import { People } from "./people.tsx";
import { Understood } from "./understood.tsx";
import { recall } from "./unfinished.ts";
import { arraysIn, upload, type Description } from "./upload.ts";
import { useLook, type Look } from "./use_look.ts";
import { Views } from "./views.tsx";

const NOTHING: Description = { name: "", fps: "", width: "", height: "", person: "", views: null, reading: {} };

export function NewScreen() {
  const [files, setFiles] = useState<Placed[]>([]);
  const [description, setDescription] = useState(() => ({ ...NOTHING, reading: readingInAddress() }));
  const [sent, setSent] = useState<number | null>(null); // share of what is being stored
  const [broken, setBroken] = useState<string | null>(null); // why nothing is sent just now
  const [trouble, setTrouble] = useState<string | null>(null);
  const stop = useRef<AbortController | null>(null);
  const look = useLook(files, description);
  useEffect(() => {
    document.title = "New capture · Fewview";
    return () => stop.current?.abort();
  }, []);

  const arrays = arraysIn(files);
  const unfinished = arrays !== null && recall(arrays) !== null;
  const setAll = (next: Placed[]) => {
    setTrouble(null);
    setFiles(next);
    const name = description.name === "" && next.length > 0 ? nameFor(next) : description.name;
    setDescription({ ...description, name, person: "", views: null });
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
        <DropZone onFiles={(found) => setAll(joined(files, found))} />
        {files.length > 0 && (
          <GroupList files={files} onRemove={(gone) => setAll(files.filter((file) => !gone.includes(file)))} />
        )}
        <Fields description={description} setDescription={setDescription} disabled={sent !== null} />
        <ReadingControls
          fields={askedOf(look, description.reading)}
          reading={description.reading}
          keypoints={look.state === "seen" ? look.preview.keypoints : null}
          onChange={(reading) => setDescription({ ...description, reading })}
        />
        <Looked look={look} editable={arrays === null} description={description} setDescription={setDescription} />
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

/** Returns the options of reading that have a control: those that a refusal or a finding names, the
 * skeleton of keypoints without names, and what was given already. */
function askedOf(look: Look, reading: Reading): string[] {
  const given = Object.keys(reading);
  if (look.state === "refused") return [...given, ...look.fields];
  if (look.state !== "seen") return given;
  const { findings, skeleton, notes } = look.preview;
  const named = (skeleton?.keypoint_names ?? null) !== null || notes.length === 0; // arrays have no notes
  return [...given, ...findings.flatMap((each) => each.remedy_fields ?? []), ...(named ? [] : ["skeleton_name"])];
}

interface LookedProps {
  look: Look;
  editable: boolean; // whether views and people can be chosen
  description: Description;
  setDescription: (description: Description) => void;
}

function Looked({ look, editable, description, setDescription }: LookedProps) {
  if (look.state === "none") return null;
  if (look.state === "refused") return <Alert>{look.reason}</Alert>;
  if (look.state === "sending") return <Sending share={look.share} then="Reading the files …" />;
  const { preview } = look;
  const names = preview.view_names ?? [];
  const views = description.views ?? names.map((name) => ({ source: name, name }));
  // Names are sent between commas.
  const nameable = editable && names.length > 0 && views.every(({ source }) => !source.includes(","));
  return (
    <>
      <section class="panel" aria-label="What was understood">
        <h2>
          What was understood <span class="quiet">{captured(preview)}. Nothing is stored yet.</span>
        </h2>
        <Understood facts={preview} frame={look.drawn} />
        {nameable && (
          <details>
            <summary>Rename, order or leave out views</summary>
            <Views
              views={views}
              onChange={(next) => {
                const kept = next.map(({ source }) => source).join() === views.map(({ source }) => source).join();
                setDescription({ ...description, views: next, person: kept ? description.person : "" });
              }}
            />
          </details>
        )}
      </section>
      {editable && preview.people && (
        <People
          people={preview.people}
          names={names}
          onChoose={(person) => setDescription({ ...description, person })}
        />
      )}
    </>
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

function DropZone({ onFiles }: { onFiles: (files: Placed[]) => void }) {
  const [over, setOver] = useState(false);
  return (
    <div
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
      <Icon name="file" />
      <strong>Drop a file or folder for each camera here, or the folder that they are in</strong>
      <div class="buttons">
        <label class="button chooser">
          Choose files
          <input type="file" multiple onChange={(event) => onFiles(chosen(event.currentTarget.files))} />
        </label>
        <label class="button chooser">
          Choose a folder
          <input
            type="file"
            multiple
            {...{ webkitdirectory: true }}
            onChange={(event) => onFiles(chosen(event.currentTarget.files))}
          />
        </label>
      </div>
      <span class="quiet">
        What DeepLabCut, SLEAP, OpenPose, COCO, MMPose, Anipose and others write: CSV, H5, folders of JSON, with their
        calibration if there is one. Or one .npz or .safetensors with an array <code>keypoints</code> (frames, views,
        keypoints, 2).
      </span>
    </div>
  );
}

function GroupList({ files, onRemove }: { files: Placed[]; onRemove: (files: Placed[]) => void }) {
  const groups = groupsOf(files);
  const folders = groups.filter(({ name }) => name.endsWith("/")).length;
  return (
    <ul class="files" aria-label="Files to send">
      {groups.map((group) => (
        <li key={group.name}>
          <span>{group.files.length === 1 ? group.files[0]?.path : group.name}</span>
          <span class="quiet">
            {group.files.length > 1 && `${count(group.files.length, "file")}, `}
            {bytes(group.files.reduce((sum, { file }) => sum + file.size, 0))}
          </span>
          <button
            type="button"
            class="icons"
            aria-label={`Leave out ${group.name}`}
            onClick={() => onRemove(group.files)}
          >
            <Icon name="close" />
          </button>
        </li>
      ))}
      <li class="quiet">
        {folders > 0
          ? `${count(files.length, "file")} in ${count(folders, "folder")}`
          : `${count(files.length, "file")}, a view each, in this order`}
      </li>
    </ul>
  );
}

/** Returns a name for a capture: that of its one folder, or what its files or folders have in common. */
function nameFor(files: Placed[]): string {
  const tops = new Set(files.map(({ path }) => path.split("/", 1)[0] ?? path));
  const names = [...tops].map((name) => name.replace(/\.[^.]*$/, ""));
  let shared = names[0] ?? "";
  for (const name of names) while (!name.startsWith(shared)) shared = shared.slice(0, -1);
  return shared.replace(/[\s_\-.]*(cam(era)?|view)?[\s_\-.]*$/i, "") || names[0] || "";
}
