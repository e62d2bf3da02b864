/** How frames are lifted: what their axes are, how they are refined, and which cameras saw them. */

import { useState } from "preact/hooks";
import { Choice } from "./choice.tsx";
import { OneOf } from "./fit_again.tsx";
import { useSubject, viewNames, type Lifting } from "./subject.ts";

const FRAMES = [
  ["room", "the room: all frames in one, where a place in it is known"],
  ["canonical", "each frame in the axes of its first view"],
] as const;

const REFINEMENTS = [
  ["auto", "automatic: where it helps"],
  ["full", "full: wherever it can be computed"],
  ["off", "off: weak perspective"],
] as const;

export function FrameControl() {
  const before = useSubject().lifting.frame ?? "room";
  const [frame, setFrame] = useState<string>(before);
  const change = frame === before ? null : { frame: frame as NonNullable<Lifting["frame"]> };
  return (
    <>
      <label>
        Frame of reference <Choice value={frame} choices={FRAMES} onChange={setFrame} />
      </label>
      <ShowAgain change={change} />
    </>
  );
}

/** Of a stream it is chosen for the stream; else for another fit. */
export function RefineControl() {
  const { fit, lifting } = useSubject();
  const before = (fit === null ? lifting.refine : fit.config?.refine) ?? "auto";
  const [refine, setRefine] = useState<string>(before);
  if (fit !== null) {
    return (
      <OneOf label="Refinement" choices={REFINEMENTS} before={before} changeTo={(chosen) => ({ refine: chosen })} />
    );
  }
  const change = refine === before ? null : { refine: refine as NonNullable<Lifting["refine"]> };
  return (
    <>
      <label>
        Refinement <Choice value={refine} choices={REFINEMENTS} onChange={setRefine} />
      </label>
      <ShowAgain change={change} />
    </>
  );
}

export function ViewsControl() {
  const { dataset, lifting } = useSubject();
  const before = lifting.views ?? [];
  const [views, setViews] = useState(before);
  const cameras = before.map((_, camera) => [`${camera}`, `camera ${camera} of the fit`] as const);
  const different = new Set(views).size === views.length;
  return (
    <>
      <table class="per-view">
        <tbody>
          {viewNames(dataset).map((name, view) => (
            <tr key={view}>
              <th scope="row">{name}</th>
              <td>
                <Choice
                  aria-label={`Camera of ${name}`}
                  value={`${views[view] ?? view}`}
                  choices={cameras}
                  onChange={(camera) => setViews(views.map((old, at) => (at === view ? Number(camera) : old)))}
                />
              </td>
            </tr>
          ))}
        </tbody>
      </table>
      {!different && <p class="quiet">Give each view a camera of its own.</p>}
      <ShowAgain change={different && views.join() !== before.join() ? { views } : null} />
    </>
  );
}

/** @param change of what was asked for; null as long as it is not complete */
export function ShowAgain({ change }: { change: Lifting | null }) {
  const { onLifting } = useSubject();
  return (
    <div class="buttons">
      <button class="primary" disabled={change === null} onClick={() => change && onLifting(change)}>
        Show it so
      </button>
    </div>
  );
}
