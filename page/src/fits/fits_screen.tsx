/** All fits, the newest first, and the datasets they are of. */

import { useEffect, useState } from "preact/hooks";
import { followFit } from "../api/events.ts";
import { listDatasets, listFits, listModels, listQueues, listThese } from "../api/lists.ts";
import { cancelFit, type Dataset, type DatasetPreview, type Fit, type WaitingJobs } from "../api/resources.ts";
import { ListScreen, NewCapture, Warnings } from "../lists/list_screen.tsx";
import type { Column } from "../lists/table.tsx";
import { useList } from "../lists/use_list.ts";
import { count, duration, moment, number, percent, pixels } from "../parts/format.ts";
import { linkTo } from "../route.ts";
import { linkToComparison } from "./comparison.tsx";
import { isGoingOn } from "./fit_screen.tsx";
import { secondsOf, unusualSettings } from "./settings.ts";
import { Status } from "./status.tsx";

const STATUSES = ["queued", "running", "succeeded", "failed", "cancelled"] as const;

export function FitsScreen() {
  const fits = useList(listFits);
  const [broken, setBroken] = useState<string | null>(null); // why a fit cannot be followed
  const { datasets, errors, trouble } = useBeside(fits.items ?? []);
  const going = (fits.items ?? []).filter(isGoingOn).map((fit) => fit.id);
  useEffect(() => {
    const stops = going.map((id) => followFit(id, fits.put, (error) => setBroken(error?.message ?? null)));
    return () => stops.forEach((stop) => stop());
    // eslint-disable-next-line react-hooks/exhaustive-deps -- the identifiers, joined, are what it depends on
  }, [going.join()]);

  const settings = unusualSettings(fits.items ?? []);
  const columns: Column<Fit>[] = [
    {
      title: "Dataset",
      cell: (fit) => <DatasetName dataset={datasets.get(fit.dataset_id)} />,
      order: (fit) => datasets.get(fit.dataset_id)?.name ?? "",
    },
    { title: "Frames", cell: ({ frames }) => frames.toLocaleString("en"), order: ({ frames }) => frames },
    { title: "Views", cell: (fit) => datasets.get(fit.dataset_id)?.views ?? "–" },
    {
      title: "Status",
      cell: (fit) => (
        <>
          <Status fit={fit} /> <Warnings findings={fit.findings} />
          {isGoingOn(fit) && <CancelButton fit={fit} onFit={fits.put} />}
        </>
      ),
      order: ({ status }) => status,
    },
    {
      title: "Error",
      cell: (fit) => pixels(errors.get(fit.model_id ?? "")),
      order: (fit) => errors.get(fit.model_id ?? "") ?? NaN,
    },
    {
      title: "Took",
      cell: (fit) => (Number.isNaN(secondsOf(fit)) ? "–" : duration(secondsOf(fit))),
      order: secondsOf,
    },
    { title: "Settings", cell: ({ id }) => settings.get(id), order: ({ id }) => settings.get(id) ?? "" },
    { title: "Version", cell: ({ version }) => version ?? "–", order: ({ version }) => version ?? "" },
    {
      title: "Made",
      cell: ({ created_at: at }) => moment(at),
      order: ({ created_at: at }) => Date.parse(at),
    },
  ];
  return (
    <ListScreen
      kind="fits"
      title="Fits"
      list={{ ...fits, trouble: fits.trouble ?? broken ?? trouble }}
      columns={columns}
      statuses={STATUSES}
      beside={<NewCapture />}
      above={going.length > 0 && <Queue key={going.length} />}
      teach={<TeachUnlessStored />}
      under={(fit) => isGoingOn(fit) && <Going fit={fit} />}
      choices={(chosen) =>
        chosen.length > 1 && (
          <a class="button" href={linkToComparison(chosen.map(({ id }) => id))}>
            Compare
          </a>
        )
      }
    >
      <Unfitted fits={fits.items} complete={fits.more === null && Object.values(fits.wanted).join("") === ""} />
    </ListScreen>
  );
}

/** Returns the datasets of fits, null where one was deleted, and the reprojection errors (pixels) of their models. */
function useBeside(fits: Fit[]) {
  const [datasets, setDatasets] = useState(new Map<string, Dataset | null>());
  const [errors, setErrors] = useState(new Map<string, number>());
  const [trouble, setTrouble] = useState<string | null>(null);
  const sets = fits.map((fit) => fit.dataset_id).filter((id) => !datasets.has(id));
  const models = fits.flatMap((fit) => (fit.model_id && !errors.has(fit.model_id) ? [fit.model_id] : []));
  useEffect(() => {
    if (sets.length === 0) return;
    listThese(listDatasets, sets).then(
      (found) => {
        const gone = sets.map((id): [string, Dataset | null] => [id, null]);
        setDatasets(
          (before) => new Map([...before, ...gone, ...found.map((each): [string, Dataset] => [each.id, each])]),
        );
      },
      (error: Error) => setTrouble(error.message),
    );
    // eslint-disable-next-line react-hooks/exhaustive-deps -- the identifiers, joined, are what it depends on
  }, [sets.join()]);
  useEffect(() => {
    if (models.length === 0) return;
    listThese(listModels, models).then(
      (found) =>
        setErrors(
          (before) =>
            new Map([...before, ...found.map(({ id, reprojection_error: e }): [string, number] => [id, e ?? NaN])]),
        ),
      (error: Error) => setTrouble(error.message),
    );
    // eslint-disable-next-line react-hooks/exhaustive-deps -- the identifiers, joined, are what it depends on
  }, [models.join()]);
  return { datasets, errors, trouble };
}

function DatasetName({ dataset }: { dataset: Dataset | null | undefined }) {
  if (dataset === undefined) return <>–</>;
  if (dataset === null) return <span class="quiet">deleted: it cannot be played</span>;
  return <a href={linkTo("datasets", dataset.id)}>{dataset.name}</a>;
}

function Going({ fit }: { fit: Fit }) {
  return (
    <>
      {fit.progress && (
        <progress
          max={1}
          value={fit.progress.step / Math.max(1, fit.progress.steps)}
          aria-label={`Progress of ${fit.name}`}
        />
      )}
      <span class="quiet">{progressOf(fit)}</span>
    </>
  );
}

/** The newest datasets that no fit is of. `complete`: all fits are known. */
function Unfitted({ fits, complete }: { fits: Fit[] | null; complete: boolean }) {
  const [newest, setNewest] = useState<Dataset[]>([]);
  useEffect(() => {
    listDatasets().then(
      (page) => setNewest(page.items),
      () => {}, // the list of datasets has them
    );
  }, []);
  if (fits === null || !complete) return null;
  const fitted = new Set(fits.map((fit) => fit.dataset_id));
  const datasets = newest.filter((dataset) => !fitted.has(dataset.id));
  if (datasets.length === 0) return null;
  return <Waiting datasets={datasets} />;
}

function TeachUnlessStored() {
  const [stored, setStored] = useState<boolean | null>(null);
  useEffect(() => {
    listDatasets({ limit: 1 }).then(
      (page) => setStored(page.items.length > 0),
      () => {},
    );
  }, []);
  return stored === false ? <Teach /> : null;
}

function Waiting({ datasets }: { datasets: Dataset[] }) {
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
      onClick={() => void cancelFit(fit.id).then(onFit, (error: Error) => setTrouble(error.message))}
    >
      {trouble === undefined ? "Cancel" : "Cannot be cancelled"}
    </button>
  );
}

/** How many fits wait, and whether anybody takes them. */
function Queue() {
  const [queues, setQueues] = useState<WaitingJobs[]>([]);
  useEffect(() => {
    listQueues().then(
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

function progressOf(fit: Fit): string {
  if (fit.status === "running" && fit.progress) {
    const left = fit.progress.seconds_left;
    return `${percent(fit.progress.step / Math.max(1, fit.progress.steps))}${left ? `, about ${duration(left)} left` : ""}`;
  }
  return fit.status === "queued" ? "waits for a worker" : "";
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
