/** What a remedy is taken for: a stored capture and, where there is one, a fit of it. */

import { createContext } from "preact";
import { useContext } from "preact/hooks";
import type { Dataset, Fit } from "../api/resources.ts";
import { numbered } from "../data/capture.ts";
import type { Take } from "../data/take.ts";
import type { Drawn } from "../datasets/preview.ts";
import type { Joined } from "../result/show.ts";

/** How frames are lifted, as far as that can be chosen where they are shown. */
export interface Lifting {
  frame?: "room" | "canonical"; // of reference
  refine?: "auto" | "off" | "full" | null; // null: as the fit was given it
  views?: readonly number[]; // of the model, which those of the frames are, in their order
  up?: readonly number[]; // a direction in the room without it; else up is estimated
}

export interface Subject {
  dataset: Dataset;
  fit: Fit | null;
  take: Take | null; // the result of the fit, as far as it is there
  picture: Drawn | null; // a frame of all views, in which keypoints can be clicked
  selected: number | null; // the keypoint that was clicked elsewhere on the screen
  model: string | null; // that a fit can start from
  lifting: Lifting; // what is left out cannot be chosen
  onDataset(dataset: Dataset): void;
  onLifting(change: Lifting): void;
  onEdges(joined: Joined | null): void; // where the structure is shown, if it is
}

/** Returns a dataset as a subject, of which nothing else is known. */
export function subjectOf(dataset: Dataset, onDataset: Subject["onDataset"]): Subject {
  const nothing = () => {};
  const unknown = { fit: null, take: null, picture: null, selected: null, model: null, lifting: {} };
  return { dataset, ...unknown, onDataset, onLifting: nothing, onEdges: nothing };
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
