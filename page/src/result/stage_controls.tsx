/** What the 3D view shows besides the structure, how long a square is, and where one looks. */

import type { ComponentChildren } from "preact";
import { useEffect, useMemo, useState } from "preact/hooks";
import { knowsDeviations } from "../data/take.ts";
import { number } from "../parts/format.ts";
import { useKept } from "../parts/kept.ts";
import type { Stage } from "./scene/scene.ts";
import { useShown } from "./show.ts";

export function StageControls({ stage, children }: { stage: Stage | null; children?: ComponentChildren }) {
  const { unit, take, version, covariances } = useShown();
  const [doubt, setDoubt] = useKept("doubt-in-3d", "off");
  // eslint-disable-next-line react-hooks/exhaustive-deps -- the version is of what the take's arrays hold
  const doubtKnown = useMemo(() => knowsDeviations(take), [take, version]);
  const [trails, setTrails] = useState(true);
  const [following, setFollowing] = useState(false);
  useEffect(() => {
    setTrails(stage?.flows ?? true);
    setFollowing(stage?.walks ?? false);
  }, [stage]);
  useEffect(() => stage?.showTrails(trails), [stage, trails]);
  const { known, ask } = covariances;
  const doubtShown = doubtKnown && doubt === "on";
  useEffect(() => (doubtShown ? ask() : undefined), [doubtShown, ask]);
  useEffect(() => stage?.showDoubt(doubtShown, known), [stage, doubtShown, known]);
  useEffect(() => stage?.follow(following), [stage, following]);
  return (
    <div class="overlay bottom">
      <span class="scale quiet">
        <i aria-hidden="true" /> square {stage === null ? "" : number(stage.square, 2)} · {unit}
        {doubtShown && " · hulls hold 68 %"}
      </span>
      <span class="buttons">
        {children}
        <button aria-pressed={trails} onClick={() => setTrails(!trails)}>
          Trails
        </button>
        {doubtKnown && (
          <button
            aria-pressed={doubt === "on"}
            onClick={() => setDoubt(doubt === "on" ? "off" : "on")}
            title="How far points may be off: each lies within its hull with 68 %, and what is doubtful fades"
          >
            Doubt
          </button>
        )}
        {stage?.walks && (
          <button aria-pressed={following} onClick={() => setFollowing(!following)}>
            Follow
          </button>
        )}
        <button onClick={() => stage?.frameSubject()} title="F">
          Subject
        </button>
        <button onClick={() => stage?.frameCameras()} title="C" disabled={take.frame === "view"}>
          Cameras
        </button>
      </span>
    </div>
  );
}
