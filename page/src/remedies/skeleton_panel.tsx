/** Names and edges of the keypoints: what there is, edges that were found, and the editor. */

import { useEffect, useMemo, useState } from "preact/hooks";
import { changeDataset, type Dataset } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";
import { count } from "../parts/format.ts";
import { constantEdges, type FoundEdge } from "../science/constant_edges.ts";
import { sidesOf } from "../science/sides.ts";
import { JointPicture } from "./joint_picture.tsx";
import { SkeletonEditor } from "./skeleton_editor.tsx";
import { keypointNames, useSubject, viewNames } from "./subject.ts";
import { useAttempt } from "./use_attempt.ts";

/** @param onSaved called after the skeleton was stored */
export function SkeletonPanel({ onSaved }: { onSaved: (dataset: Dataset) => void }) {
  const { dataset, take } = useSubject();
  const [open, setOpen] = useState(false);
  const edges = dataset.skeleton?.edges ?? [];
  const found = useMemo(() => (take === null || edges.length > 0 ? [] : constantEdges(take)), [take, edges.length]);
  const named = dataset.skeleton?.keypoint_names ?? null;
  const done = (changed: Dataset) => {
    setOpen(false);
    onSaved(changed);
  };
  return (
    <section class="panel" aria-label="Skeleton">
      <h2>
        Skeleton{" "}
        <span class="quiet">
          {named === null ? "the keypoints have no names" : count(dataset.keypoints, "named keypoint")},{" "}
          {edges.length === 0 ? "nothing joins them" : count(edges.length, "edge")}
        </span>
      </h2>
      {found.length > 0 && !open && <Offer found={found} onDone={done} />}
      <details open={open} onToggle={(event) => setOpen(event.currentTarget.open)}>
        <summary>Name keypoints, draw edges</summary>
        {open && <SkeletonEditor onDone={done} />}
      </details>
    </section>
  );
}

/** Edges that were found from constant lengths: dashed, until they are accepted. */
function Offer({ found, onDone }: { found: FoundEdge[]; onDone: (dataset: Dataset) => void }) {
  const { dataset, picture, onEdges } = useSubject();
  const { busy, trouble, attempt } = useAttempt();
  const names = keypointNames(dataset);
  const edges = useMemo(() => found.map(({ edge }) => edge), [found]);
  useEffect(() => {
    onEdges({ edges, offered: true });
    return () => onEdges(null);
  }, [edges, onEdges]);
  const keep = () =>
    attempt(async () => {
      const skeleton = { keypoint_names: dataset.skeleton?.keypoint_names ?? null, edges };
      onDone(await changeDataset(dataset.id, { skeleton }));
    });
  return (
    <div class="offer">
      <p>
        These {count(edges.length, "pair")} of keypoints keep their distance in the structures, as the ends of a bone
        do.
      </p>
      {picture !== null && (
        <JointPicture
          picture={picture}
          names={names}
          viewNames={viewNames(dataset)}
          edges={[]}
          offered={edges}
          sides={sidesOf(names)}
          marked={[]}
          onJoint={() => {}}
        />
      )}
      <Alert>{trouble}</Alert>
      <button class="primary" disabled={busy} onClick={keep}>
        Draw these edges
      </button>
    </div>
  );
}
