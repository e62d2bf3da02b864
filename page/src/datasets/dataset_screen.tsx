/** What was understood of a capture, and the fit that can be made of it. */

import { useEffect, useState } from "preact/hooks";
import { listAll, listFits } from "../api/lists.ts";
import { createFit, getDataset, type Dataset, type Fit } from "../api/resources.ts";
import { remoteCapture } from "../data/remote.ts";
import { captured } from "../fits/fits_screen.tsx";
import { Tags } from "../lists/tags.tsx";
import { Alert, Waiting } from "../parts/alert.tsx";
import { DeleteButton, NamedHeading } from "../parts/named.tsx";
import { Remediable } from "../remedies/provider.tsx";
import { subjectOf } from "../remedies/subject.ts";
import { SkeletonPanel } from "../remedies/skeleton_panel.tsx";
import { goTo, linkTo } from "../route.ts";
import { CalibrationChoice, NOTHING_GIVEN } from "./calibration.tsx";
import { ConfigForm } from "./config_form.tsx";
import { drawnAs, fullestFrame, type Drawn } from "./preview.ts";
import { Understood } from "./understood.tsx";

export function DatasetScreen({ id }: { id: string }) {
  const [dataset, setDataset] = useState<Dataset | null>(null);
  const [trouble, setTrouble] = useState<string | null>(null);
  const [config, setConfig] = useState<Record<string, unknown>>({});
  const [given, setGiven] = useState(NOTHING_GIVEN);
  const [busy, setBusy] = useState(false);
  const [frame, setFrame] = useState<Drawn | null>(null);
  const [fits, setFits] = useState<Fit[]>([]);
  useEffect(() => {
    listAll(listFits, { dataset_id: id, status: "succeeded" }).then(setFits, () => {}); // the words do without
    getDataset(id).then(
      (found) => {
        setDataset(found);
        document.title = `${found.name} · Fewview`;
      },
      (error: Error) => setTrouble(error.message),
    );
    remoteCapture(id)
      .then(fullestFrame)
      .then(setFrame, () => {}); // the words do without
  }, [id]);
  const attempt = async (work: () => Promise<void>) => {
    setBusy(true);
    setTrouble(null);
    await work().catch((error: Error) => setTrouble(error.message));
    setBusy(false);
  };
  if (dataset === null) return <Waiting trouble={trouble} />;
  const taken = (changed: Dataset) => {
    setDataset(changed);
    if (frame !== null) setFrame(drawnAs(frame, changed));
  };
  const subject = { ...subjectOf(dataset, taken), picture: frame };
  return (
    <main>
      <header class="title">
        <NamedHeading kind="datasets" id={id} name={dataset.name} onName={(name) => setDataset({ ...dataset, name })} />
        <span class="quiet">{captured(dataset)}</span>
      </header>
      <Tags key={dataset.id} kind="datasets" id={dataset.id} tags={dataset.tags} />
      <Remediable subject={subject}>
        <section class="panel">
          <h2>What was understood</h2>
          <Understood facts={dataset} frame={frame} />
        </section>
        <SkeletonPanel onSaved={taken} />
      </Remediable>
      <section class="panel">
        <h2>Fit it</h2>
        <p>The defaults suit most captures. A minute or two for a thousand frames; you may close the page meanwhile.</p>
        <CalibrationChoice dataset={dataset} onChange={setGiven} />
        <ConfigForm dataset={dataset} onChange={setConfig} />
        <Alert>{trouble}</Alert>
        <div class="buttons">
          <button
            class="primary"
            disabled={busy}
            onClick={() =>
              void attempt(async () => {
                const all = { ...config, ...given.config };
                const fit = await createFit({
                  dataset_id: dataset.id,
                  name: dataset.name,
                  config: all,
                  ...given.fields,
                });
                goTo("fits", fit.id);
              })
            }
          >
            Start the fit
          </button>
        </div>
      </section>
      {fits.length > 0 && (
        <section class="panel">
          <h2>Fits of it</h2>
          <p class="where">
            {fits.map((fit) => (
              <a key={fit.id} class="chip" href={linkTo("fits", fit.id)}>
                {fit.name} ({fit.id.slice(-6)})
              </a>
            ))}
          </p>
        </section>
      )}
      <DeleteButton kind="datasets" id={id} what="this dataset" onDeleted={() => goTo("datasets")} />
    </main>
  );
}
