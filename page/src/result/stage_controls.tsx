/** What the 3D view shows besides the structure, how long a square is, and where one looks. */

import type { ComponentChildren } from "preact";
import { useEffect, useState } from "preact/hooks";
import { number } from "../parts/format.ts";
import type { Stage } from "./scene/scene.ts";
import { useShown } from "./show.ts";

export function StageControls({ stage, children }: { stage: Stage | null; children?: ComponentChildren }) {
  const { unit, take } = useShown();
  const [trails, setTrails] = useState(true);
  const [following, setFollowing] = useState(false);
  useEffect(() => {
    setTrails(stage?.flows ?? true);
    setFollowing(stage?.walks ?? false);
  }, [stage]);
  useEffect(() => stage?.showTrails(trails), [stage, trails]);
  useEffect(() => stage?.follow(following), [stage, following]);
  return (
    <div class="overlay bottom">
      <span class="scale quiet">
        <i aria-hidden="true" /> square {stage === null ? "" : number(stage.square, 2)} · {unit}
      </span>
      <span class="buttons">
        {children}
        <button aria-pressed={trails} onClick={() => setTrails(!trails)}>
          Trails
        </button>
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
