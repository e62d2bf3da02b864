/** The result screen: the structure, the views, the errors in time, and what was noticed. */

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type { Fit } from "../api/resources.ts";
import { rateOf } from "../data/take.ts";
import type { Result } from "../data/loading.ts";
import { FindingList } from "../parts/finding_list.tsx";
import { number } from "../parts/format.ts";
import { Icon } from "../parts/icons.tsx";
import { onThemeChange, readTheme } from "../parts/theme.ts";
import { currentRoute, keepInAddress } from "../route.ts";
import { frameErrors, keypointErrors } from "../science/errors.ts";
import { frameFindings } from "../science/frame_findings.ts";
import { WEAK } from "../science/projection.ts";
import { worstFrames } from "../science/worst.ts";
import type { Crop } from "./crop.ts";
import { Exports } from "./exports.tsx";
import { Figures } from "./figures.tsx";
import { listenToKeys, SHORTCUTS } from "./keys.ts";
import { createLoop } from "./loop.ts";
import type { Overlay } from "./overlay_choice.tsx";
import { createPlayer } from "./player.ts";
import type { Stage } from "./scene/scene.ts";
import { ShowContext, type Show } from "./show.ts";
import { StagePanel } from "./stage_panel.tsx";
import { Timeline } from "./timeline.tsx";
import { Transport } from "./transport.tsx";
import { ViewPanel } from "./view_panel.tsx";

const WORST = 10; // frames that are marked

export function Workspace({ fit, result }: { fit: Fit; result: Result }) {
  const { take, model, cameras } = result;
  const [stage, setStage] = useState<Stage | null>(null);
  const [theme, setTheme] = useState(readTheme);
  const [selected, select] = useState<number | null>(null);
  const [through, setThrough] = useState<number | null>(null);
  const [crop, setCrop] = useState<Crop>("subject");
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

  const show: Show = {
    ...{ fit, model, cameras, take, player, loop, theme, means, worst, findings, errors, errorsDone: done },
    ...{ selected, select, through, lookThrough, posed, overlay, setOverlay },
  };
  return (
    <ShowContext.Provider value={show}>
      <div class="result">
        <div class="screens">
          <StagePanel onStage={setStage} />
          <section class="views" aria-label="Views" data-count={take.views}>
            {take.viewNames.map((name, view) => (
              <ViewPanel key={name} view={view} crop={crop} />
            ))}
          </section>
        </div>
        <section class="panel playing" aria-label="Time">
          <Transport />
          <Timeline />
          <Legend show={show} crop={crop} setCrop={setCrop} />
        </section>
        <div class="facts-grid">
          <section class="panel">
            <h2>What was noticed</h2>
            <WorstFrames show={show} />
            <FindingList
              findings={findings}
              viewNames={take.viewNames}
              keypointNames={take.names}
              onFrame={(frame) => player.show(frame)}
              onKeypoint={select}
            />
          </section>
          <section class="panel">
            <h2>Figures</h2>
            <Figures />
          </section>
          <section class="panel">
            <h2>Take it away</h2>
            <Exports stage={stage} />
            <CopyLink stage={stage} frame={() => player.frame} />
            <Shortcuts />
          </section>
        </div>
      </div>
    </ShowContext.Provider>
  );
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

function Legend({ show, crop, setCrop }: { show: Show; crop: Crop; setCrop: (crop: Crop) => void }) {
  return (
    <div class="legend quiet">
      <span>
        <i class="dot left" /> left
      </span>
      <span>
        <i class="dot right" /> right
      </span>
      <span>
        <i class="dot middle" /> neither
      </span>
      <span>
        <i class="stroke projected" /> structure, projected
      </span>
      <span>
        <i class="stroke bad" /> its distance from what was detected
      </span>
      <span>
        <i class="cross">×</i> outlier
      </span>
      <label class="check last">
        mark
        <select
          value={show.selected ?? ""}
          onChange={({ currentTarget: { value } }) => show.select(value === "" ? null : Number(value))}
        >
          <option value="">no keypoint</option>
          {show.take.names.map((name, keypoint) => (
            <option key={keypoint} value={keypoint}>
              {name}
            </option>
          ))}
        </select>
      </label>
      <label class="check">
        views show
        <select value={crop} onChange={(event) => setCrop(event.currentTarget.value as Crop)}>
          <option value="subject">the subject</option>
          <option value="path">wherever it goes</option>
          <option value="image">whole images</option>
        </select>
      </label>
    </div>
  );
}

/** The frames in which the structure fits least to what was detected. */
function WorstFrames({ show: { worst, means, player } }: { show: Show }) {
  if (worst.length === 0) return null;
  return (
    <p class="where worst-frames">
      <span class="quiet">Look first at frame</span>
      {worst.slice(0, 6).map((frame) => (
        <button class="chip" key={frame} onClick={() => player.show(frame)}>
          {frame} <span class="quiet">{number(means[frame])} px</span>
        </button>
      ))}
    </p>
  );
}

function CopyLink({ stage, frame }: { stage: Stage | null; frame: () => number }) {
  const [copied, setCopied] = useState(false);
  const copy = async () => {
    const query: Record<string, string> = { frame: `${frame()}` };
    if (stage !== null) query.angle = stage.angle().map((value) => value.toPrecision(5)).join(",");
    keepInAddress(query);
    try {
      await navigator.clipboard.writeText(location.href);
      setCopied(true);
      setTimeout(() => setCopied(false), 3000);
    } catch {
      setCopied(false); // not allowed here: the address bar has the link
    }
  };
  return (
    <div class="exports">
      <span>A link to this frame and angle</span>
      <span class="buttons">
        <button onClick={() => void copy()}>
          <Icon name={copied ? "check" : "link"} /> {copied ? "Copied" : "Copy link"}
        </button>
      </span>
    </div>
  );
}

function Shortcuts() {
  return (
    <details>
      <summary>Keys</summary>
      <dl class="keys">
        {SHORTCUTS.map(([key, what]) => (
          <div key={key}>
            <dt>
              <kbd>{key}</kbd>
            </dt>
            <dd>{what}</dd>
          </div>
        ))}
      </dl>
    </details>
  );
}
