/** What was understood of a capture, and the fit that can be made of it. */

import { useEffect, useRef, useState } from "preact/hooks";
import { createFit, deleteDataset, getCapture, getDataset, type Dataset } from "../api/resources.ts";
import { readNpz } from "../data/npz.ts";
import { captureOf, type Capture } from "../data/take.ts";
import { captured } from "../fits/fits_screen.tsx";
import { FindingList } from "../parts/finding_list.tsx";
import { percent } from "../parts/format.ts";
import { goTo } from "../route.ts";
import { ConfigForm } from "./config_form.tsx";
import { drawKeypoints } from "./preview.ts";

export function DatasetScreen({ id }: { id: string }) {
  const [dataset, setDataset] = useState<Dataset | null>(null);
  const [trouble, setTrouble] = useState<string | null>(null);
  const [config, setConfig] = useState<Record<string, unknown>>({});
  const [busy, setBusy] = useState(false);
  useEffect(() => {
    getDataset(id).then(
      (found) => {
        setDataset(found);
        document.title = `${found.name} · Fewview`;
      },
      (error: Error) => setTrouble(error.message),
    );
  }, [id]);
  const attempt = async (work: () => Promise<void>) => {
    setBusy(true);
    setTrouble(null);
    await work().catch((error: Error) => setTrouble(error.message));
    setBusy(false);
  };
  if (dataset === null) return <main>{trouble === null ? <p class="quiet">Loading …</p> : <p class="trouble">{trouble}</p>}</main>;
  return (
    <main>
      <header class="title">
        <h1>{dataset.name}</h1>
        <span class="quiet">{captured(dataset)}</span>
      </header>
      <section class="panel">
        <h2>What was understood</h2>
        {dataset.notes.length > 0 && (
          <ul class="notes">
            {dataset.notes.map((note) => (
              <li key={note}>{note}</li>
            ))}
          </ul>
        )}
        <Preview dataset={dataset} />
        <FindingList
          findings={dataset.findings}
          viewNames={dataset.view_names ?? undefined}
          keypointNames={dataset.skeleton?.keypoint_names ?? undefined}
        />
      </section>
      <section class="panel">
        <h2>Fit it</h2>
        <p>
          The defaults suit most captures. A minute or two for a thousand frames; you may close the page meanwhile.
        </p>
        <ConfigForm dataset={dataset} onChange={setConfig} />
        {trouble !== null && (
          <p class="trouble" role="alert">
            {trouble}
          </p>
        )}
        <div class="buttons">
          <button
            class="primary"
            disabled={busy}
            onClick={() =>
              void attempt(async () => {
                const fit = await createFit({ dataset_id: dataset.id, name: dataset.name, config });
                goTo("fits", fit.id);
              })
            }
          >
            Start the fit
          </button>
          <button
            disabled={busy}
            onClick={() => {
              if (!confirm(`Delete ${dataset.name}? Models that were fitted to it stay.`)) return;
              void attempt(async () => {
                await deleteDataset(dataset.id);
                goTo();
              });
            }}
          >
            Delete this dataset
          </button>
        </div>
      </section>
    </main>
  );
}

/** The first frame in which most keypoints are seen, as each view shows it. */
function Preview({ dataset }: { dataset: Dataset }) {
  const [capture, setCapture] = useState<Capture | null>(null);
  const holder = useRef<HTMLDivElement>(null);
  useEffect(() => {
    let current = true;
    getCapture(dataset.id).then(
      (bytes) => current && setCapture(captureOf(readNpz(bytes))),
      () => {}, // the words above and below do without
    );
    return () => {
      current = false;
    };
  }, [dataset.id]);
  useEffect(() => {
    if (capture === null || holder.current === null) return;
    [...holder.current.querySelectorAll("canvas")].forEach((canvas, view) => drawKeypoints(canvas, capture, view));
  }, [capture]);
  return (
    <div class="previews" ref={holder}>
      {dataset.missing_fraction.map((missing, view) => (
        <figure key={view}>
          <canvas role="img" aria-label={`A frame of view ${view}`} />
          <figcaption>
            {dataset.view_names?.[view] ?? `view ${view}`} <span class="quiet">{percent(1 - missing)} observed</span>
          </figcaption>
        </figure>
      ))}
    </div>
  );
}
