/** What a remedy is taken for: a stored capture and, where there is one, a fit of it. */

import { createContext } from "preact";
import { useContext } from "preact/hooks";
import type { Dataset, Fit } from "../api/resources.ts";
import { numbered } from "../data/capture.ts";
import type { Take } from "../data/take.ts";
import type { Drawn } from "../datasets/preview.ts";

export interface Subject {
  dataset: Dataset;
  fit: Fit | null;
  take: Take | null; // the result of the fit, as far as it is there
  picture: Drawn | null; // a frame of all views, in which keypoints can be clicked
  selected: number | null; // the keypoint that was clicked elsewhere on the screen
  onDataset(dataset: Dataset): void;
}

export const SubjectContext = createContext<Subject | null>(null);

export function useSubject(): Subject {
  const subject = useContext(SubjectContext);
  if (subject === null) throw new Error("Nothing is mended here.");
  return subject;
}

/** Returns the names of a dataset's keypoints, or words that count them. */
export function keypointNames({ skeleton, keypoints }: Dataset): string[] {
  return skeleton?.keypoint_names ?? numbered("keypoint", keypoints);
}

/** Returns the names of a dataset's views, or words that count them. */
export function viewNames({ view_names: names, views }: Dataset): string[] {
  return names ?? numbered("view", views);
}
