/** Remedies for which another capture is stored or fitted. */

import { useEffect, useState } from "preact/hooks";
import { listAll, listDatasets } from "../api/lists.ts";
import { createFit, type Dataset } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";
import { goTo, linkTo } from "../route.ts";
import { Choice } from "./choice.tsx";
import { useSubject, viewNames } from "./subject.ts";
import { useAttempt } from "./use_attempt.ts";

/** The files of a capture are not kept, so they are chosen again. */
export function MirrorControl() {
  const names = viewNames(useSubject().dataset);
  const [mirrored, setMirrored] = useState<readonly string[]>([]);
  const turn = (name: string) =>
    setMirrored(mirrored.includes(name) ? mirrored.filter((each) => each !== name) : [...mirrored, name]);
  return (
    <>
      <p>Which views show mirror images? Choose their files again, and they are read so.</p>
      <div class="checks">
        {names.map((name) => (
          <label key={name}>
            <input type="checkbox" checked={mirrored.includes(name)} onChange={() => turn(name)} /> {name}
          </label>
        ))}
      </div>
      <div class="buttons">
        {mirrored.length > 0 && (
          <a
            class="button primary"
            href={`${linkTo("datasets", "new")}?${new URLSearchParams({ mirror: mirrored.join() })}`}
          >
            Choose the files
          </a>
        )}
        <span class="quiet">This dataset stays.</span>
      </div>
    </>
  );
}

/** Fits a capture that has the poses which are wanting, starting from the model. */
export function FromModelControl() {
  const { dataset, model } = useSubject();
  const [fitting, setFitting] = useState<Dataset[]>([dataset]);
  const [chosen, setChosen] = useState(dataset.id);
  const { busy, trouble, attempt } = useAttempt();
  useEffect(() => {
    listAll(listDatasets).then(
      (found) => setFitting(found.filter(({ keypoints }) => keypoints === dataset.keypoints)),
      () => {}, // the capture itself can be fitted
    );
  }, [dataset.keypoints]);
  const name = fitting.find(({ id }) => id === chosen)?.name ?? dataset.name;
  const go = () =>
    attempt(async () => goTo("fits", (await createFit({ dataset_id: chosen, name, from_model: model })).id));
  return (
    <>
      <label>
        A capture that has such poses{" "}
        <Choice
          value={chosen}
          choices={fitting.map((each) => [each.id, `${each.name} (${each.id.slice(-6)})`] as const)}
          onChange={setChosen}
        />
      </label>
      <Alert>{trouble}</Alert>
      <div class="buttons">
        <button class="primary" disabled={busy} onClick={go}>
          Fit it, starting from this model
        </button>
      </div>
    </>
  );
}
