/** All fits, the newest first, and the datasets they are of. */

import { useEffect, useState } from "preact/hooks";
import { followFit } from "../api/events.ts";
import {
  cancelFit,
  getQueues,
  listDatasets,
  listFits,
  listModels,
  type Dataset,
  type DatasetPreview,
  type Fit,
  type WaitingJobs,
} from "../api/resources.ts";
import { count, duration, moment, number, percent, pixels } from "../parts/format.ts";
import { Icon } from "../parts/icons.tsx";
import { linkTo } from "../route.ts";
import { isGoingOn } from "./fit_screen.tsx";
import { Status } from "./status.tsx";

export function FitsScreen() {
  const [fits, setFits] = useState<Fit[] | null>(null);
  const [datasets, setDatasets] = useState<Dataset[]>([]);
  const [next, setNext] = useState<string | null>(null);
  const [errors, setErrors] = useState(new Map<string, number>()); // pixels, by model
  const [trouble, setTrouble] = useState<string | null>(null);

  useEffect(() => {
    document.title = "Fits · Fewview";
    Promise.all([listFits(), listDatasets(), listModels()]).then(
      ([found, sets, models]) => {
        setFits(found.items);
        setNext(found.next_cursor ?? null);
        setDatasets(sets.items);
        setErrors(new Map(models.items.flatMap((model) => (model.reprojection_error ? [[model.id, model.reprojection_error]] : []))));
      },
      (error: Error) => setTrouble(error.message),
    );
  }, []);
  const going = (fits ?? []).filter(isGoingOn).map((fit) => fit.id);
  const put = (fit: Fit) => setFits((all) => all?.map((each) => (each.id === fit.id ? fit : each)) ?? null);
  useEffect(() => {
    const stops = going.map((id) => followFit(id, put, (error) => setTrouble(error?.message ?? null)));
    return () => stops.forEach((stop) => stop());
  }, [going.join()]);

  const more = async () => {
    const page = await listFits(next ?? undefined);
    setFits([...(fits ?? []), ...page.items]);
    setNext(page.next_cursor ?? null);
  };
  const fitted = new Set((fits ?? []).map((fit) => fit.dataset_id));
  const unfitted = datasets.filter((dataset) => !fitted.has(dataset.id));
  return (
    <main>
      <header class="title">
        <h1>Fits</h1>
        <a class="button primary" href={linkTo("datasets", "new")}>
          <Icon name="plus" /> New capture
        </a>
      </header>
      {trouble !== null && (
        <p class="trouble" role="alert">
          {trouble}
        </p>
      )}
      {going.length > 0 && <Queue key={going.length} />}
      {fits?.length === 0 && unfitted.length === 0 && <Teach />}
      <ul class="list">
        {fits?.map((fit) => (
          <li key={fit.id} class={isGoingOn(fit) ? "going" : ""}>
            <FitRow
              fit={fit}
              dataset={datasets.find((dataset) => dataset.id === fit.dataset_id)}
              error={errors.get(fit.model_id ?? "")}
            />
            {isGoingOn(fit) && <CancelButton fit={fit} onFit={put} />}
          </li>
        ))}
      </ul>
      {next !== null && <button onClick={() => void more()}>Older fits</button>}
      {unfitted.length > 0 && (
        <>
          <h2>Datasets that wait to be fitted</h2>
          <ul class="list">
            {unfitted.map((dataset) => (
              <li key={dataset.id}>
                <a class="panel row" href={linkTo("datasets", dataset.id)}>
                  <strong>{dataset.name}</strong>
                  <span class="quiet">{captured(dataset)}</span>
                  <span class="quiet">{moment(dataset.created_at)}</span>
                </a>
              </li>
            ))}
          </ul>
        </>
      )}
    </main>
  );
}

function CancelButton({ fit, onFit }: { fit: Fit; onFit: (fit: Fit) => void }) {
  const [trouble, setTrouble] = useState<string | undefined>(undefined);
  return (
    <button
      disabled={fit.cancel_requested}
      title={trouble}
      aria-label={`Cancel ${fit.name}`}
      onClick={() => cancelFit(fit.id).then(onFit, (error: Error) => setTrouble(error.message))}
    >
      {trouble === undefined ? "Cancel" : "Cannot be cancelled"}
    </button>
  );
}

/** How many fits wait, and whether anybody takes them. */
function Queue() {
  const [queues, setQueues] = useState<WaitingJobs[]>([]);
  useEffect(() => {
    getQueues().then(
      (page) => setQueues(page.items),
      () => {}, // the fits say enough
    );
  }, []);
  const fits = queues.find((each) => each.queue === "fits");
  if (fits === undefined) return null;
  const oldest = `the oldest for ${duration(fits.oldest_seconds)}`;
  const waiting = fits.waiting > 0 ? `${count(fits.waiting, "fit")} in the queue, ${oldest}` : "No fit waits";
  const none = "No worker is running: fewview worker starts one.";
  return (
    <p class="quiet">
      {waiting}. {fits.workers === 0 ? none : `${count(fits.workers, "worker")} at work.`}
    </p>
  );
}

interface RowProps {
  fit: Fit;
  dataset: Dataset | undefined;
  error: number | undefined; // pixels
}

function FitRow({ fit, dataset, error }: RowProps) {
  const warnings = fit.findings.filter((finding) => finding.severity === "warning").length;
  return (
    <a class="panel row" href={linkTo("fits", fit.id)}>
      <strong>{fit.name}</strong>
      <span class="quiet">{dataset ? `${dataset.name}: ${captured(dataset)}` : count(fit.frames, "frame")}</span>
      <span class="facts">
        <Status fit={fit} />
        {warnings > 0 && (
          <span class="warned">
            <Icon name="warning" /> {count(warnings, "warning")}
          </span>
        )}
        {error !== undefined && <span>{pixels(error)}</span>}
        <span class="quiet">{progressOf(fit)}</span>
      </span>
      {isGoingOn(fit) && fit.progress && (
        <progress max={1} value={fit.progress.step / Math.max(1, fit.progress.steps)} aria-label={`Progress of ${fit.name}`} />
      )}
    </a>
  );
}

function progressOf(fit: Fit): string {
  if (fit.status === "running" && fit.progress) {
    const left = fit.progress.seconds_left;
    return `${percent(fit.progress.step / Math.max(1, fit.progress.steps))}${left ? `, about ${duration(left)} left` : ""}`;
  }
  return moment(fit.finished_at ?? fit.created_at);
}

export function captured(dataset: Dataset | DatasetPreview): string {
  const rate = dataset.fps ? ` at ${number(dataset.fps)} frames/s` : "";
  return `${count(dataset.frames, "frame")}${rate}, ${count(dataset.views, "view")}, ${count(dataset.keypoints, "keypoint")}`;
}

function Teach() {
  return (
    <section class="panel teach">
      <h2>From what your cameras saw to 3D, in three steps</h2>
      <ol>
        <li>
          <strong>Drop the files of a detector</strong>, one for each camera: DeepLabCut, SLEAP, OpenPose, COCO, MMPose
          and more. Two cameras suffice, three are better; none has to be calibrated.
        </li>
        <li>
          <strong>Fit.</strong> A minute or two, for most captures. You see the error fall.
        </li>
        <li>
          <strong>Look.</strong> Turn the subject around beside its views, see where the answer is doubtful, and take it
          away as files.
        </li>
      </ol>
      <a class="button primary" href={linkTo("datasets", "new")}>
        <Icon name="plus" /> Start with a capture
      </a>
      <p class="quiet">
        No capture at hand? <code>make demo</code> fits one of three actors.
      </p>
    </section>
  );
}
