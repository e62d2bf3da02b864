/** Streams: those that programs have open, and one of the page's own, which sends the frames of a stored
 * capture as cameras would and shows what comes back. */

import { useEffect, useState } from "preact/hooks";
import { listAll, listDatasets, listModels } from "../api/lists.ts";
import { getCameras, type Dataset, type ModelSummary } from "../api/resources.ts";
import { rateOf } from "../data/capture.ts";
import { structures } from "../data/loader.ts";
import { frameOf, queryFor } from "../data/loading.ts";
import { remoteCapture } from "../data/remote.ts";
import { emptyTake, putStructures } from "../data/take.ts";
import type { Frame } from "../data/placing.ts";
import { captured } from "../fits/fits_screen.tsx";
import { Alert } from "../parts/alert.tsx";
import { linkTo } from "../route.ts";
import { extentOf } from "../result/scene/scene.ts";
import type { Extent } from "../result/scene/parts.ts";
import { LivePanels, type Running } from "./live_panels.tsx";
import { OpenStreams } from "./open_streams.tsx";
import { subjectOf, type Lifting } from "../remedies/subject.ts";
import { unitOf } from "../result/unit.ts";
import { startReplay, START } from "./replay.ts";

const OVERVIEW = 300; // frames of the fit that say where the subject goes

export default function LiveScreen() {
  const [models, setModels] = useState<ModelSummary[] | null>(null);
  const [datasets, setDatasets] = useState<Dataset[]>([]);
  const [model, setModel] = useState("");
  const [chosen, setChosen] = useState({ dataset: "", rate: "" });
  const [running, setRunning] = useState<Running | null>(null);
  const [lifting, setLifting] = useState<Lifting>({});
  const [trouble, setTrouble] = useState<string | null>(null);
  useEffect(() => {
    document.title = "Live · Fewview";
    Promise.all([listAll(listModels), listAll(listDatasets)]).then(
      ([found, sets]) => {
        setModels(found);
        setDatasets(sets);
        setModel(found[0]?.id ?? "");
      },
      (error: Error) => setTrouble(error.message),
    );
  }, []);
  const used = models?.find((each) => each.id === model);
  const fitting = datasets.filter(
    (each) => each.keypoints === used?.keypoints && each.views === (used.views ?? each.views),
  );
  const dataset =
    fitting.find((each) => each.id === chosen.dataset) ??
    fitting.find((each) => each.id === used?.dataset_id) ??
    fitting[0];

  const start = async (change: Lifting) => {
    setTrouble(null);
    if (used === undefined || dataset === undefined) return;
    try {
      const rate = Number(chosen.rate) || undefined;
      setLifting(change);
      setRunning(await prepared(used, dataset.id, rate, change));
    } catch (error) {
      setTrouble((error as Error).message);
    }
  };
  if (models?.length === 0) return <Teach />;
  const subject =
    used === undefined || dataset === undefined
      ? null
      : {
          ...subjectOf(dataset, (changed) =>
            setDatasets(datasets.map((each) => (each.id === changed.id ? changed : each))),
          ),
          model: used.id,
          lifting: asked(lifting, dataset.views),
          onLifting: (change: Lifting) => void start({ ...lifting, ...change }),
        };
  return (
    <main class="wide">
      <header class="title">
        <h1>Live</h1>
        <span class="quiet">Streams of frames, lifted as they come.</span>
      </header>
      {running === null && <OpenStreams models={models ?? []} />}
      {running === null && <h2>A stream of a stored capture</h2>}
      <form
        class="panel live-form"
        onSubmit={(event) => {
          event.preventDefault();
          if (running === null) void start({});
          else setRunning(null);
        }}
      >
        <label>
          Model
          <select value={model} disabled={running !== null} onChange={(event) => setModel(event.currentTarget.value)}>
            {models?.map((each) => (
              <option key={each.id} value={each.id}>
                {each.name} ({each.id.slice(-6)})
              </option>
            ))}
          </select>
        </label>
        <label>
          Capture
          <select
            value={dataset?.id ?? ""}
            disabled={running !== null}
            onChange={(event) => setChosen({ ...chosen, dataset: event.currentTarget.value })}
          >
            {fitting.map((each) => (
              <option key={each.id} value={each.id}>
                {each.name}: {captured(each)}
              </option>
            ))}
          </select>
        </label>
        <label>
          Frames per second
          <input
            type="number"
            min={1}
            max={1000}
            step="any"
            disabled={running !== null}
            placeholder={dataset?.fps ? `${dataset.fps}, as captured` : "30, a guess"}
            value={chosen.rate}
            onInput={(event) => setChosen({ ...chosen, rate: event.currentTarget.value })}
          />
        </label>
        <button class={running === null ? "primary" : ""} disabled={dataset === undefined}>
          {running === null ? "Start" : "Stop"}
        </button>
      </form>
      {used !== undefined && dataset === undefined && (
        <p class="quiet">No stored capture has the {used.keypoints} keypoints and the views of this model.</p>
      )}
      <Alert>{trouble}</Alert>
      {running === null ? <How /> : <LivePanels running={running} subject={subject} />}
    </main>
  );
}

/** Returns how frames are lifted, with what holds where nothing was chosen. */
function asked({ frame = "room", refine = null, views }: Lifting, count: number): Lifting {
  return { frame, refine, views: views ?? Array.from({ length: count }, (_, view) => view) };
}

/** Returns all that a stream needs to be shown. */
async function prepared(
  model: ModelSummary,
  dataset: string,
  rate: number | undefined,
  lifting: Lifting,
): Promise<Running> {
  const [file, cameras] = await Promise.all([remoteCapture(dataset), getCameras(model.id)]);
  const frame = lifting.frame === "canonical" ? "view" : frameOf(cameras);
  const posed = file.capture.viewNames.map((_, view) =>
    cameras.views.some(({ index }) => index === (lifting.views?.[view] ?? view)),
  );
  const extent = await extentOfFit(model, frame, file.capture);
  const { refine, views } = lifting;
  const start = { model: model.id, ...START[frame], ...(refine && { refine }), ...(views && { views }) };
  const perSecond = rate ?? rateOf(file.capture).rate;
  return {
    ...{
      unit: unitOf(model),
      frames: file.capture.frames,
      numbered: true,
      posed,
      rate: perSecond,
      ...(extent ? { extent } : {}),
    },
    start: (listener) => startReplay(file, start, frame, perSecond, listener),
  };
}

/** Returns where the subject of a model's fit went in a frame of reference. */
async function extentOfFit(
  { fit_id: fit, frames }: ModelSummary,
  frame: Frame,
  capture: Parameters<typeof emptyTake>[0],
): Promise<Extent | undefined> {
  if (!fit || !frames) return undefined;
  const slice = `::${Math.ceil(frames / OVERVIEW)}`;
  const found = await structures(fit, queryFor(frame), slice);
  const take = emptyTake(capture, found.get("points3d")?.shape[0] ?? 0, frame);
  putStructures(take, found, 0, 1);
  return extentOf(take);
}

function How() {
  return (
    <section class="panel teach">
      <h2>What a capture program would see</h2>
      <p>
        Start sends the frames of a stored capture through <code>/lift/stream</code>, one by one and in time, and shows
        each answer as it comes: the structure, the views, how long an answer takes, which frames were dropped because
        they came too fast.
      </p>
      <p class="quiet">
        Your own program does the same with its cameras&rsquo; frames: <code>examples/stream.py</code>,{" "}
        <code>stream.cpp</code> and <code>stream.ts</code> are whole capture loops.
      </p>
    </section>
  );
}

function Teach() {
  return (
    <main>
      <header class="title">
        <h1>Live</h1>
      </header>
      <section class="panel teach">
        <h2>A stream needs a model</h2>
        <p>
          Fit a capture first. Its model then lifts each frame of the same cameras in a few milliseconds, and you watch
          it here.
        </p>
        <a class="button primary" href={linkTo("datasets", "new")}>
          Start with a capture
        </a>
      </section>
    </main>
  );
}
