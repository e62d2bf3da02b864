/** Loads what a remedy needs to know of a fit's dataset. */

import { useEffect, useState } from "preact/hooks";
import { getDataset, type Dataset, type Fit } from "../api/resources.ts";
import type { CaptureFile } from "../data/capture.ts";
import { remoteCapture } from "../data/remote.ts";
import { fullestFrame, type Drawn } from "../datasets/preview.ts";
import { subjectOf, type Subject } from "./subject.ts";

/** What is shown of a result. */
interface Shown extends Partial<Pick<Subject, "take" | "selected" | "lifting" | "onLifting" | "onEdges">> {
  file?: CaptureFile; // of the dataset, if it is open already
}

const nothing = () => {};

/** Returns the subject of a fit's remedies; null until its dataset is there, or if it was deleted. */
export function useSubjectOf(fit: Fit, { file, ...shown }: Shown = {}): Subject | null {
  const [dataset, setDataset] = useState<Dataset | null>(null);
  const [picture, setPicture] = useState<Drawn | null>(null);
  useEffect(() => {
    let current = true;
    // The words do without.
    getDataset(fit.dataset_id).then((found) => current && setDataset(found), nothing);
    const opened = file === undefined ? remoteCapture(fit.dataset_id) : Promise.resolve(file);
    opened.then(fullestFrame).then((frame) => current && setPicture(frame), nothing);
    return () => {
      current = false;
    };
  }, [fit.dataset_id, file]);
  if (dataset === null) return null;
  return { ...subjectOf(dataset, setDataset), fit, model: fit.model_id ?? null, picture, ...shown };
}
