/** All that the parts of the result screen share: what follows from a result, and what is chosen. */

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type { Fit } from "../api/resources.ts";
import type { Result } from "../data/loading.ts";
import { rateOf } from "../data/take.ts";
import { onThemeChange, readTheme } from "../parts/theme.ts";
import { currentRoute } from "../route.ts";
import { frameErrors, keypointErrors } from "../science/errors.ts";
import { frameFindings } from "../science/frame_findings.ts";
import { WEAK } from "../science/projection.ts";
import { worstFrames } from "../science/worst.ts";
import { listenToKeys } from "./keys.ts";
import { createLoop } from "./loop.ts";
import type { Overlay } from "./overlay_choice.tsx";
import { createPlayer } from "./player.ts";
import type { Stage } from "./scene/scene.ts";
import type { Show } from "./show.ts";

const WORST = 10; // frames that are marked

export function useResult(fit: Fit, result: Result, stage: Stage | null): Show {
  const { take, model, cameras } = result;
  const [theme, setTheme] = useState(readTheme);
  const [selected, select] = useState<number | null>(null);
  const [through, setThrough] = useState<number | null>(null);
  const player = useMemo(
    () => createPlayer(take.frames, rateOf(take).rate, Number(currentRoute().query.get("frame") ?? 0) || 0),
    [take],
  );
  const loop = useMemo(() => createLoop(player), [player]);
  const means = useMemo(() => frameErrors(take), [take]);
  const worst = useMemo(() => worstFrames(means, WORST, Math.max(5, take.frames / 60)), [means]);
  const [overlay, setOverlay] = useState<Overlay | null>(null);
  const posed = useMemo(() => posedViews(take), [take]);
  const lookThrough = (view: number | null) => setThrough(view === null || posed[view] ? view : null);
  const findings = useMemo(() => {
    const known = new Set(fit.findings.map((finding) => finding.code));
    return [...fit.findings, ...frameFindings(take.frameBits).filter((finding) => !known.has(finding.code))];
  }, [fit, take]);
  const { errors, done } = useKeypointErrors(take);
  const stageNow = useRef<Stage | null>(null);
  stageNow.current = stage;

  useEffect(() => () => loop.close(), [loop]);
  useEffect(() => onThemeChange(() => setTheme(readTheme())), []);
  useEffect(
    () => listenToKeys({ player, worst, views: take.views, stage: () => stageNow.current, lookThrough, select }),
    [player, worst],
  );
  useEffect(() => {
    const angle = currentRoute().query.get("angle")?.split(",").map(Number);
    if (stage !== null && angle?.length === 6 && angle.every(Number.isFinite)) stage.setAngle(angle);
  }, [stage]);

  return {
    ...{ fit, model, cameras, take, player, loop, theme, means, worst, findings, errors, errorsDone: done },
    ...{ selected, select, through, lookThrough, posed, overlay, setOverlay },
  };
}

function posedViews({ views, frames, cameras }: Result["take"]): boolean[] {
  return Array.from({ length: views }, (_, view) => {
    for (let frame = 0; frame < frames; frame++) if (cameras.models[frame * views + view] > WEAK) return true;
    return false;
  });
}

/** Computes the errors of all keypoints in pieces, between which the browser may draw. */
function useKeypointErrors(take: Result["take"]) {
  const work = useMemo(() => keypointErrors(take), [take]);
  const [done, setDone] = useState(false);
  useEffect(() => {
    let stopped = false;
    const go = () => {
      if (stopped) return;
      if (work.next()) setDone(true);
      else setTimeout(go);
    };
    setDone(false);
    setTimeout(go, 100);
    return () => {
      stopped = true;
    };
  }, [work]);
  return { errors: work.errors, done };
}
