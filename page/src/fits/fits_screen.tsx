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
import { ListScreen, NewCapture, Warnings } from "../parts/list_screen.tsx";
import { useList } from "../parts/use_list.ts";
import { linkTo } from "../route.ts";
import { isGoingOn } from "./fit_screen.tsx";
import { Status } from "./status.tsx";

export function FitsScreen() {
  const fits = useList(listFits);
  const [datasets, setDatasets] = useState<Dataset[] | null>(null);
  const [errors, setErrors] = useState(new Map<string, number>()); // pixels, by model
  const [broken, setBroken] = useState<string | null>(null); // why a fit cannot be followed

  useEffect(() => {
    Promise.all([listDatasets(), listModels()]).then(
      ([sets, models]) => {
        setDatasets(sets.items);
        setErrors(
          new Map(
            models.items.flatMap((model) => (model.reprojection_error ? [[model.id, model.reprojection_error]] : [])),
          ),
        );
      },
      (error: Error) => setBroken(error.message),
    );
  }, []);
  const going = (fits.items ?? []).filter(isGoingOn).map((fit) => fit.id);
  useEffect(() => {
    const stops = going.map((id) => followFit(id, fits.put, (error) => setBroken(error?.message ?? null)));
    return () => stops.forEach((stop) => stop());
  }, [going.join()]);

  const row = (fit: Fit) => (
    <>
      <FitRow
        fit={fit}
        dataset={datasets?.find((dataset) => dataset.id === fit.dataset_id)}
        error={errors.get(fit.model_id ?? "")}
      />
      {isGoingOn(fit) && <CancelButton fit={fit} onFit={fits.put} />}
    </>
  );
  const fitted = new Set((fits.items ?? []).map((fit) => fit.dataset_id));
  const unfitted = fits.items === null ? [] : (datasets ?? []).filter((dataset) => !fitted.has(dataset.id));
  return (
    <ListScreen
      title="Fits"
      list={{ ...fits, trouble: fits.trouble ?? broken }}
      beside={<NewCapture />}
      above={going.length > 0 && <Queue key={going.length} />}
      teach={datasets?.length === 0 && <Teach />}
      row={row}
      isGoing={isGoingOn}
    >
      {unfitted.length > 0 && <Unfitted datasets={unfitted} />}
    </ListScreen>
  );
}

function Unfitted({ datasets }: { datasets: Dataset[] }) {
  return (
    <>
      <h2>Datasets that wait to be fitted</h2>
      <ul class="list">
        {datasets.map((dataset) => (
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
  return (
    <a class="panel row" href={linkTo("fits", fit.id)}>
      <strong>{fit.name}</strong>
      <span class="quiet">{dataset ? `${dataset.name}: ${captured(dataset)}` : count(fit.frames, "frame")}</span>
      <span class="facts">
        <Status fit={fit} />
        <Warnings findings={fit.findings} />
        {error !== undefined && <span>{pixels(error)}</span>}
        <span class="quiet">{progressOf(fit)}</span>
      </span>
      {isGoingOn(fit) && fit.progress && (
        <progress
          max={1}
          value={fit.progress.step / Math.max(1, fit.progress.steps)}
          aria-label={`Progress of ${fit.name}`}
        />
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
      <NewCapture>Start with a capture</NewCapture>
      <p class="quiet">
        No capture at hand? <code>make demo</code> fits one of three actors.
      </p>
    </section>
  );
}
