/** The structure in three dimensions, with the cameras' names on it. */

import type { ComponentChildren } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { Alert } from "../parts/alert.tsx";
import type { Numbers } from "../science/numbers.ts";
import type { Extent } from "./scene/parts.ts";
import { nearest } from "../data/take.ts";
import { pickOn } from "./scene/picking.ts";
import { createStage, type Stage } from "./scene/scene.ts";
import { useShown } from "./show.ts";
import { StageControls } from "./stage_controls.tsx";

const FRAMES = {
  level: "In the room: y up, on the floor where feet are named.",
  camera: "In the axes of the first static camera, turned upright.",
  view: "Each frame in the axes of its first view: no camera is known to be static.",
} as const;
const TURNS: Record<string, [number, number]> = {
  ArrowLeft: [-1, 0],
  ArrowRight: [1, 0],
  ArrowUp: [0, 1],
  ArrowDown: [0, -1],
};

interface Props {
  onStage: (stage: Stage | null) => void;
  extent?: Extent; // of the subject, if it does not follow from the frames that are there
  overlay?: Numbers | null; // other points (N, P, 3), laid over the structure
  title?: string; // in the place of where one is
  plain?: boolean; // without controls
  children?: ComponentChildren; // further controls
}

export function StagePanel({ onStage, extent, overlay = null, title, plain = false, children }: Props) {
  const show = useShown();
  const holder = useRef<HTMLDivElement>(null);
  const labels = useRef<HTMLDivElement>(null);
  const [stage, setStage] = useState<Stage | null>(null);
  const [trouble, setTrouble] = useState<string | null>(null);
  const { take, player, loop, theme, selected, select, through, lookThrough, joined } = show;

  useEffect(() => {
    if (holder.current === null) return undefined;
    let made: Stage;
    try {
      made = createStage(holder.current, take, player.frame, extent);
    } catch {
      setTrouble("This browser draws nothing in three dimensions: it has no WebGL.");
      return undefined;
    }
    describe(made.canvas, take.keypoints);
    setStage(made);
    onStage(made);
    return () => {
      onStage(null);
      made.close();
    };
    // eslint-disable-next-line react-hooks/exhaustive-deps -- a scene is made once for a take
  }, [take]);

  useEffect(() => {
    if (stage === null) return undefined;
    stage.onLeaveCamera(() => lookThrough(null));
    return loop.addAlways(() => {
      if (stage.draw(nearest(take, player.frame))) placeLabels(stage, labels.current);
    });
    // eslint-disable-next-line react-hooks/exhaustive-deps -- to leave a camera, any `lookThrough` will do
  }, [stage, loop, player, take]);

  useEffect(() => {
    stage?.lookThrough(through);
    stage?.join(joined);
    stage?.paint(theme, selected);
  }, [stage, theme, selected, through, joined]);

  useEffect(() => {
    if (stage === null) return undefined;
    return pickOn(stage.canvas, { names: take.names, places: stage.keypointPlaces, onPick: select });
  }, [stage, take, select]);

  useEffect(() => stage?.spoil(), [stage, show.version]);
  useEffect(() => stage?.overlay(overlay), [stage, overlay]);

  const turnByKey = (event: KeyboardEvent) => {
    const turn = TURNS[event.key];
    if (turn === undefined || stage === null) return;
    event.preventDefault();
    event.stopPropagation();
    stage.orbit(0.1 * turn[0], 0.1 * turn[1]);
  };

  return (
    <section class="panel stage" aria-label={title === undefined ? "Structure in 3D" : `Structure in 3D: ${title}`}>
      <div ref={holder} onKeyDown={turnByKey} />
      <div class="labels" ref={labels}>
        {take.viewNames.map((name, view) => (
          <button key={view} hidden onClick={() => lookThrough(view)} title={`Look through ${name}`}>
            {name}
          </button>
        ))}
      </div>
      <Alert>{trouble}</Alert>
      <div class="overlay top">
        {through === null ? (
          title === undefined ? (
            <span class="quiet">{FRAMES[take.frame]}</span>
          ) : (
            <strong>{title}</strong>
          )
        ) : (
          <button onClick={() => lookThrough(null)}>
            Through {take.viewNames[through]} · leave <kbd>Esc</kbd>
          </button>
        )}
      </div>
      {!plain && <StageControls stage={stage}>{children}</StageControls>}
    </section>
  );
}

function describe(canvas: HTMLCanvasElement, keypoints: number): void {
  canvas.tabIndex = 0;
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", `3D structure, ${keypoints} keypoints. Drag or use the arrow keys to turn it.`);
}

function placeLabels(stage: Stage, labels: HTMLDivElement | null): void {
  if (labels === null) return;
  stage.cameraPlaces().forEach((place, view) => {
    const label = labels.children[view] as HTMLElement | undefined;
    if (label === undefined) return;
    if (label.hidden !== (place === null)) label.hidden = place === null;
    if (place !== null) label.style.transform = `translate(${Math.round(place.x)}px, ${Math.round(place.y)}px)`;
  });
}
