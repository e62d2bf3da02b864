/** The structure and, if one likes, another beside it, both seen from the same place. */

import { useEffect, useMemo, useState } from "preact/hooks";
import type { Take } from "../data/take.ts";
import type { Numbers } from "../science/numbers.ts";
import { NO_CAMERA } from "../science/projection.ts";
import { OverlayChoice } from "./overlay_choice.tsx";
import type { Stage } from "./scene/scene.ts";
import { ShownContext, useShow } from "./show.ts";
import { StagePanel } from "./stage_panel.tsx";

export function TwoStages({ stage, onStage }: { stage: Stage | null; onStage: (stage: Stage | null) => void }) {
  const show = useShow();
  const { overlay, fit, take, loop } = show;
  const [wanted, setBeside] = useState(false);
  const [second, setSecond] = useState<Stage | null>(null);
  const beside = wanted && overlay !== null;
  const other = useMemo(() => (overlay === null ? null : withPoints(take, overlay.points)), [take, overlay]);
  useEffect(() => {
    if (stage === null || second === null) return undefined;
    second.follow(false); // it goes where the first goes
    return loop.addAlways(locked(stage, second));
  }, [stage, second, loop]);
  return (
    <div class={`stages${beside ? " two" : ""}`}>
      <StagePanel
        onStage={onStage}
        overlay={beside ? null : (overlay?.points ?? null)}
        {...(beside ? { title: fit.name } : {})}
      >
        <OverlayChoice />
        {overlay !== null && (
          <button aria-pressed={beside} onClick={() => setBeside(!beside)}>
            Side by side
          </button>
        )}
      </StagePanel>
      {beside && other !== null && (
        <ShownContext.Provider value={{ ...show, take: other, posed: show.posed.map(() => false), through: null }}>
          <StagePanel key={overlay.name} onStage={setSecond} title={overlay.name} plain />
        </ShownContext.Provider>
      )}
    </div>
  );
}

/** Returns a take of other structures, of which neither cameras are known nor how far they may be off. */
function withPoints(take: Take, points: Numbers): Take {
  const models = new Int8Array(take.cameras.models.length).fill(NO_CAMERA);
  const deviations = new Float32Array(take.deviations.length).fill(NaN);
  return { ...take, points, deviations, cameras: { ...take.cameras, models } };
}

/** Returns what keeps two stages seen from the same place, whichever is turned. */
function locked(first: Stage, second: Stage): () => void {
  let before: number[] = [];
  return () => {
    const [a, b] = [first.angle(), second.angle()];
    const turned = (angle: number[]) => angle.some((value, at) => value !== before[at]);
    if (turned(a)) second.setAngle(a);
    else if (turned(b)) first.setAngle(b);
    else return;
    before = first.angle();
  };
}
