/** How files of detectors are to be read: a control for each option that a reader asks for. */

import { currentRoute } from "../route.ts";
import { Choice } from "./choice.tsx";
import { choicesOf, useKnownSkeletons } from "./known_skeletons.ts";

/** Options by the names of the form's fields, as they were typed; empty ones are left out. */
export type Reading = Readonly<Record<string, string>>;

interface Option {
  label: string;
  hint: string;
  choices?: Readonly<Record<string, string>>; // words of values; what happens anyway has none
}

/** A test holds their names against those that the service knows. */
export const READING: Record<string, Option> = {
  skeleton_name: { label: "Skeleton", hint: "names the keypoints, and joins them" },
  person: { label: "Person", hint: "0 is seen most; a number for each camera, such as 0,1,0; or a track's name" },
  format: { label: "Format", hint: "as docs/files.md names it; found out if not given" },
  min_confidence: { label: "Least confidence", hint: "0 to 1: detections that are less sure are gaps" },
  align: {
    label: "What belongs together",
    hint: "in time",
    choices: { "": "found out", index: "frames of the same number", time: "frames of the nearest time" },
  },
  table_columns: { label: "Columns of the table", hint: "such as x={}_x,y={}_y,frame=No" },
  cameras: { label: "Cameras", hint: "which views are wanted, in their order: cam1,cam2" },
  trial: { label: "Trial", hint: "or detector, where files are of several" },
  y: {
    label: "y counts",
    hint: "from the upper or the lower edge of the image",
    choices: { "": "down, as in images", up: "up" },
  },
  mirror: { label: "Mirrored views", hint: "which views show mirror images, such as cam2" },
  offset: { label: "Corner of a crop", hint: "in the whole image, from which keypoints count, such as cam2=560,180" },
  offset_seconds: { label: "Late by, in seconds", hint: "each view against the others, such as cam2=4.2" },
  views_in_names: { label: "Cameras in the names of keypoints", hint: "such as real,mirror; none if there are none" },
};

/** Returns the options that a link to the form has given. */
export function readingInAddress(): Reading {
  return Object.fromEntries([...currentRoute().query].filter(([field]) => field in READING));
}

interface Props {
  fields: readonly string[]; // those that are shown; others are ignored
  reading: Reading;
  keypoints: number | null; // of the files, if that is known
  onChange: (reading: Reading) => void;
}

export function ReadingControls({ fields, reading, keypoints, onChange }: Props) {
  const shown = Object.entries(READING).filter(([field]) => fields.includes(field));
  if (shown.length === 0) return null;
  return (
    <fieldset class="fields reading">
      <legend class="unseen">How the files are read</legend>
      {shown.map(([field, { label, hint, choices }]) => {
        const named = { value: reading[field] ?? "", "aria-label": label };
        const put = (value: string) => onChange({ ...reading, [field]: value });
        return (
          <label key={field}>
            {label} <small class="quiet">{hint}</small>
            {field === "skeleton_name" ? (
              <SkeletonChoice {...named} keypoints={keypoints} onChange={put} />
            ) : choices !== undefined ? (
              <Choice {...named} choices={Object.entries(choices)} onChange={put} />
            ) : (
              <input {...named} maxLength={1000} onChange={(event) => put(event.currentTarget.value)} />
            )}
          </label>
        );
      })}
    </fieldset>
  );
}

interface ChoiceProps {
  value: string;
  "aria-label": string;
  keypoints: number | null;
  onChange: (name: string) => void;
}

/** The ready skeletons of so many keypoints, or all if that is not known. */
function SkeletonChoice({ keypoints, ...named }: ChoiceProps) {
  const fitting = useKnownSkeletons().filter(
    ({ keypoint_names: names }) => keypoints === null || names.length === keypoints,
  );
  return <Choice {...named} choices={[["", "none"], ...choicesOf(fitting)]} />;
}
