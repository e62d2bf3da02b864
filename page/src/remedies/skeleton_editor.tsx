/** Names the keypoints of a dataset, and draws what joins them. */

import { useEffect, useMemo, useState } from "preact/hooks";
import { changeDataset, readDataset, type Dataset, type KnownSkeleton } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";
import { count } from "../parts/format.ts";
import { constantEdges } from "../science/constant_edges.ts";
import { sidesOf } from "../science/sides.ts";
import { Choice } from "./choice.tsx";
import { JointPicture } from "./joint_picture.tsx";
import { choicesOf, useKnownSkeletons } from "./known_skeletons.ts";
import {
  draftOf,
  joined,
  like,
  paired,
  problemOf,
  renamed,
  skeletonOf,
  toggled,
  type Draft,
} from "./skeleton_draft.ts";
import { useSubject, viewNames } from "./subject.ts";
import { useAttempt } from "./use_attempt.ts";

type Mode = "edges" | "sides";

const HINTS: Record<Mode, string> = {
  edges: "Click two keypoints to join them. Click an edge to remove it.",
  sides: "Click the left one of a pair, then the right one. Left and right are the subject's own.",
};

/** @param onDone called after the skeleton was stored */
export function SkeletonEditor({ onDone }: { onDone: (dataset: Dataset) => void }) {
  const { dataset, take, picture, onEdges } = useSubject();
  const [steps, setSteps] = useState<Draft[]>([]); // the last one is shown, those before can be had back
  const [tag, setTag] = useState<string | null>(null);
  const [mode, setMode] = useState<Mode>("edges");
  const [first, setFirst] = useState<number | null>(null); // of two keypoints that are clicked
  const { busy, trouble, attempt } = useAttempt();
  const found = useMemo(() => (take === null ? [] : constantEdges(take).map(({ edge }) => edge)), [take]);

  useEffect(() => {
    attempt(async () => {
      const now = await readDataset(dataset.id);
      const { skeleton, keypoints } = now.dataset;
      setTag(now.tag);
      setSteps([draftOf(skeleton?.keypoint_names, (skeleton?.edges ?? []) as [number, number][], keypoints)]);
    });
    // eslint-disable-next-line react-hooks/exhaustive-deps -- read once for each dataset
  }, [dataset.id]);

  const draft = steps.at(-1);
  useEffect(() => onEdges(draft === undefined ? null : { edges: draft.edges, offered: false }), [draft, onEdges]);
  useEffect(() => () => onEdges(null), [onEdges]);
  if (draft === undefined) return trouble === null ? <p class="quiet">Loading …</p> : <Alert>{trouble}</Alert>;
  const change = (next: Draft) => setSteps([...steps, next]);
  const click = (keypoint: number) => {
    if (first === null) return setFirst(keypoint);
    setFirst(null);
    if (first === keypoint) return;
    change(mode === "edges" ? toggled(draft, first, keypoint) : paired(draft, first, keypoint));
  };
  const problem = problemOf(draft);
  const save = () => attempt(async () => onDone(await changeDataset(dataset.id, { skeleton: skeletonOf(draft) }, tag)));
  return (
    <div class="skeleton-editor">
      <Ready draft={draft} onChoose={change} />
      <div class="buttons" role="group" aria-label="What clicks do">
        <button aria-pressed={mode === "edges"} onClick={() => setMode("edges")}>
          Edges
        </button>
        <button aria-pressed={mode === "sides"} onClick={() => setMode("sides")}>
          Left and right
        </button>
        {found.length > 0 && <button onClick={() => change(joined(draft, found))}>Add edges of constant length</button>}
        <button disabled={draft.edges.length === 0} onClick={() => change({ ...draft, edges: [] })}>
          Remove all edges
        </button>
        <button disabled={steps.length < 2} onClick={() => setSteps(steps.slice(0, -1))}>
          Undo
        </button>
      </div>
      <p class="quiet">{HINTS[mode]}</p>
      {picture === null ? (
        <p class="quiet">Loading a frame …</p>
      ) : (
        <JointPicture
          picture={picture}
          names={draft.names}
          viewNames={viewNames(dataset)}
          edges={draft.edges}
          sides={sidesOf(draft.names)}
          marked={first === null ? [] : [first]}
          onJoint={click}
          onEdge={([a, b]) => change(toggled(draft, a, b))}
        />
      )}
      <details>
        <summary>Names of {count(draft.names.length, "keypoint")}</summary>
        <ol class="names" start={0}>
          {draft.names.map((name, keypoint) => (
            <li key={keypoint}>
              <input
                aria-label={`Name of keypoint ${keypoint}`}
                value={name}
                maxLength={100}
                onChange={(event) => change(renamed(draft, keypoint, event.currentTarget.value))}
              />
            </li>
          ))}
        </ol>
      </details>
      <Alert>{trouble ?? problem}</Alert>
      <div class="buttons">
        <button class="primary" disabled={busy || problem !== null || steps.length < 2} onClick={save}>
          Save the skeleton
        </button>
        <span class="quiet" role="status">
          {count(draft.edges.length, "edge")}
        </span>
      </div>
    </div>
  );
}

/** The ready skeletons that fit a draft. */
function Ready({ draft, onChoose }: { draft: Draft; onChoose: (draft: Draft) => void }) {
  const fitting = useKnownSkeletons().flatMap((each): [KnownSkeleton, Draft][] => {
    const next = like(draft, each);
    return next === null ? [] : [[each, next]];
  });
  if (fitting.length === 0) return null;
  const choose = (wanted: string) => {
    const chosen = fitting.find(([{ name }]) => name === wanted);
    if (chosen !== undefined) onChoose(chosen[1]);
  };
  return (
    <label>
      A ready skeleton{" "}
      <Choice value="" choices={[["", "choose …"], ...choicesOf(fitting.map(([each]) => each))]} onChange={choose} />
    </label>
  );
}
