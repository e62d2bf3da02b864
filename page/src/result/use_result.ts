/** All that the parts of the result screen share: what follows from a result, and what is chosen. */

import { useCallback, useEffect, useLayoutEffect, useMemo, useRef, useState } from "preact/hooks";
import type { Fit } from "../api/resources.ts";
import { rateOf } from "../data/capture.ts";
import type { Result } from "../data/loading.ts";
import { ALL } from "../data/take.ts";
import { onThemeChange, readTheme } from "../parts/theme.ts";
import { currentRoute } from "../route.ts";
import { frameErrors, keypointErrors } from "../science/errors.ts";
import { frameFindings, rangesOf } from "../science/frame_findings.ts";
import { WEAK } from "../science/projection.ts";
import { worstFrames } from "../science/worst.ts";
import { useEditing } from "./correcting/use_editing.ts";
import { listenToKeys } from "./keys.ts";
import { createLoop } from "./loop.ts";
import { createPlayer, type Player } from "./player.ts";
import type { Stage } from "./scene/scene.ts";
import { useSelection } from "./selection.ts";
import type { Joined, Overlay, Show } from "./show.ts";
import { fittedOf, unitOf } from "./unit.ts";
import { useCovariances } from "./use_covariances.ts";

const WORST = 10; // frames that are marked
const PAUSE_MS = 250; // between two drawings of what has come

/** @param first frame that is shown */
export function useResult(fit: Fit, result: Result, first: number, stage: Stage | null): Show {
  const { take, model, cameras, file, loader, query } = result;
  const [theme, setTheme] = useState(readTheme);
  const selection = useSelection();
  const [through, setThrough] = useState<number | null>(null);
  // eslint-disable-next-line react-hooks/exhaustive-deps -- the first frame is that of the take
  const player = useMemo(() => createPlayer(take.frames, rateOf(take).rate, first), [take]);
  const loop = useMemo(() => createLoop(player), [player]);
  const { version, done, trouble } = useFrames(loader, player);
  // eslint-disable-next-line react-hooks/exhaustive-deps -- the version is of what the take's arrays hold
  const means = useMemo(() => frameErrors(take), [take, version]);
  const worst = useMemo(() => worstFrames(means, WORST, Math.max(5, take.frames / 60)), [means, take]);
  const [overlay, setOverlay] = useState<Overlay | null>(null);
  const [joined, join] = useState<Joined | null>(null);
  // eslint-disable-next-line react-hooks/exhaustive-deps -- the version is of what the take's arrays hold
  const posed = useMemo(() => posedViews(take), [take, version]);
  const lookThrough = useCallback(
    (view: number | null) => setThrough(view === null || posed[view] ? view : null),
    [posed],
  );
  const findings = useMemo(() => {
    const known = new Set(fit.findings.map((finding) => finding.code));
    return [...fit.findings, ...frameFindings(take.frameBits).filter((finding) => !known.has(finding.code))];
    // eslint-disable-next-line react-hooks/exhaustive-deps -- the version is of what the take's arrays hold
  }, [fit, take, version]);
  const { errors, errorsDone } = useKeypointErrors(result, done);
  const covariances = useCovariances(fit.id, result);
  const editing = useEditing(fit, result, loop);
  const stageNow = useRef<Stage | null>(null);
  stageNow.current = stage;

  useEffect(() => () => loop.close(), [loop]);
  useEffect(() => loop.wake(), [loop, version]);
  useEffect(() => onThemeChange(() => setTheme(readTheme())), []);
  // Before what they act on is seen: an early key would be lost.
  useLayoutEffect(
    () => listenToKeys({ player, worst, views: take.views, stage: () => stageNow.current, lookThrough }),
    [player, worst, take, lookThrough],
  );
  useEffect(() => {
    const angle = currentRoute().query.get("angle")?.split(",").map(Number);
    if (stage !== null && angle?.length === 6 && angle.every(Number.isFinite)) stage.setAngle(angle);
  }, [stage]);

  return {
    ...{
      fit,
      model,
      unit: unitOf(fittedOf(fit, model)),
      cameras,
      take,
      file,
      query,
      player,
      loop,
      theme,
      means,
      worst,
      findings,
      errors,
      errorsDone,
      editing,
      covariances,
    },
    ...selection,
    ...{ through, lookThrough, posed, overlay, setOverlay, joined, join, version, done, trouble },
  };
}

/** Has all frames fetched, those first that are looked at. */
function useFrames(loader: Result["loader"], player: Player) {
  const [state, setState] = useState({ version: 0, done: loader.done, trouble: false });
  useEffect(() => {
    let timer: ReturnType<typeof setTimeout> | undefined;
    const stopPart = loader.onPart(() => {
      const report = () => {
        timer = undefined;
        setState(({ version }) => ({ version: version + 1, done: loader.done, trouble: false }));
      };
      timer ??= setTimeout(report, PAUSE_MS);
    });
    loader.onTrouble(() => setState((before) => ({ ...before, trouble: true })));
    const stopPlayer = player.onChange(() => loader.want(player.frame));
    loader.start();
    return () => {
      clearTimeout(timer);
      stopPart();
      stopPlayer();
      loader.stop();
    };
  }, [loader, player]);
  return state;
}

function posedViews({ views, frames, cameras }: Result["take"]): boolean[] {
  return Array.from({ length: views }, (_, view) => {
    for (let frame = 0; frame < frames; frame++) if (cameras.models[frame * views + view]! > WEAK) return true;
    return false;
  });
}

/** Computes the errors of all keypoints in pieces, as their frames come. */
function useKeypointErrors({ take, loader }: Result, allThere: boolean) {
  const work = useMemo(() => keypointErrors(take), [take]);
  const [errorsDone, setDone] = useState(false);
  useEffect(() => {
    let timer: ReturnType<typeof setTimeout> | undefined;
    const go = () => {
      timer = undefined;
      if (!work.next()) timer = setTimeout(go);
      else if (loader.done) setDone(true);
    };
    const add = (first: number, end: number) => {
      work.add(first, end);
      timer ??= setTimeout(go, 100);
    };
    setDone(false);
    for (const [first, last] of rangesOf(take.frames, (frame) => take.there[frame] === ALL)) add(first, last + 1);
    const stop = loader.onPart(add);
    return () => {
      stop();
      clearTimeout(timer);
    };
  }, [work, loader, take]);
  return { errors: work.errors, errorsDone: errorsDone && allThere };
}
