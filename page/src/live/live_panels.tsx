/** What a stream brings: the structure, the views, how fast answers come, and what was noticed. */

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { Alert } from "../parts/alert.tsx";
import { FigureList } from "../parts/figure_list.tsx";
import { FindingList } from "../parts/finding_list.tsx";
import { count, number } from "../parts/format.ts";
import { onThemeChange, readTheme } from "../parts/theme.ts";
import { Remediable } from "../remedies/provider.tsx";
import type { Subject } from "../remedies/subject.ts";
import { createLoop } from "../result/loop.ts";
import { createPlayer } from "../result/player.ts";
import type { Extent } from "../result/scene/parts.ts";
import { useSelection } from "../result/selection.ts";
import { ShownContext, type Shown } from "../result/show.ts";
import { NO_COVARIANCES } from "../result/use_covariances.ts";
import { StagePanel } from "../result/stage_panel.tsx";
import { ViewPanel } from "../result/view_panel.tsx";
import { frameFindings } from "../science/frame_findings.ts";
import type { Trouble } from "./connection.ts";
import type { Feed, Figures, Listener } from "./feed.ts";
import { LatencyCurve } from "./latency_curve.tsx";

/** What is streamed, and how. */
export interface Running {
  unit: string; // of lengths, in words
  frames: number; // that there is room for
  numbered: boolean; // whether their numbers say anything to who looks on
  posed: boolean[];
  extent?: Extent; // of the subject; without one it is that of the first answers
  rate?: number; // frames per second that are sent, where that is known
  start(listener: Listener): Feed;
}

const FIRST_ANSWERS = 30;
const PERIOD_MS = 250; // between two looks at the figures

/** @param subject what remedies are taken for; null where a program asks for what is lifted */
export function LivePanels({ running, subject = null }: { running: Running; subject?: Subject | null }) {
  const [trouble, setTrouble] = useState<Trouble | null>(null);
  const { feed, shown: begun, come } = useFeed(running, setTrouble);
  useRegularLook(feed);
  const ready = come.current >= (running.extent !== undefined ? 1 : FIRST_ANSWERS);
  const { take, figures } = feed;
  const noticed = frameFindings(take.frameBits).map((each) => (running.numbered ? each : { ...each, frames: [] }));
  const shown: Shown = { ...begun, done: ready };
  return (
    <ShownContext.Provider value={shown}>
      <Alert>{trouble && `${trouble.reason} ${trouble.forGood ? "" : "Trying again."}`}</Alert>
      <div class="result">
        <div class="screens live">
          {ready ? (
            <StagePanel onStage={() => {}} {...(running.extent ? { extent: running.extent } : {})} />
          ) : (
            <section class="panel stage waiting">
              <p class="quiet">{figures.connected ? "Waiting for the first answers …" : "Connecting …"}</p>
            </section>
          )}
          <section class="views" aria-label="Views" data-count={take.views}>
            {take.viewNames.map((_, view) => (
              <ViewPanel key={view} view={view} crop="subject" />
            ))}
          </section>
        </div>
        <div class="facts-grid halves">
          <section class="panel" aria-label="Stream">
            <h2>The stream</h2>
            <StreamFigures figures={figures} rate={running.rate} />
            <LatencyCurve seconds={figures.seconds} />
          </section>
          <section class="panel">
            <h2>What was noticed</h2>
            <Remediable subject={subject}>
              <FindingList findings={noticed} viewNames={take.viewNames} keypointNames={take.names} />
            </Remediable>
          </section>
        </div>
      </div>
    </ShownContext.Provider>
  );
}

function StreamFigures({ figures, rate }: { figures: Figures; rate: number | undefined }) {
  const { connected, sent, answered, dropped, refused, notLifted, perSecond } = figures;
  const { median, p95 } = figures.seconds.at(-1) ?? { median: null, p95: null };
  const rows: [string, string][] = [
    ["Connection", connected ? "open" : "closed"],
    ["An answer takes", `${number(median)} ms in the median, ${number(p95)} ms at p95`],
    ["Answers", `${number(perSecond)} a second${rate === undefined ? "" : `, of ${number(rate)} frames a second`}`],
    ["Answered", `${count(answered, "frame")}${sent === undefined ? "" : `, of ${sent.toLocaleString("en")} sent`}`],
    ["Dropped", count(dropped, "frame")],
    ["Refused", count(refused, "frame")],
    ["Not lifted", count(notLifted, "frame")],
  ];
  return <FigureList rows={rows} />;
}

/** Shows what comes as long as the screen is there. */
function useFeed(running: Running, setTrouble: (trouble: Trouble | null) => void) {
  const { unit, frames, posed } = running;
  const [theme, setTheme] = useState(readTheme);
  const [through, setThrough] = useState<number | null>(null);
  const selection = useSelection();
  const come = useRef(0); // frames
  const player = useMemo(() => createPlayer(frames, running.rate ?? 30, 0), [frames, running]);
  const loop = useMemo(() => createLoop(player), [player]);
  const feed = useMemo(() => {
    come.current = 0;
    return running.start({
      onFrame(frame) {
        come.current++;
        player.show(frame);
        loop.wake();
      },
      onTrouble: setTrouble,
      onReady: () => setTrouble(null),
    });
    // eslint-disable-next-line react-hooks/exhaustive-deps -- player and loop are of what runs; to start anew for another listener would lose frames
  }, [running]);
  useEffect(
    () => () => {
      feed.stop();
      loop.close();
    },
    [feed, loop],
  );
  useEffect(() => onThemeChange(() => setTheme(readTheme())), []);
  const lookThrough = (view: number | null) => setThrough(view === null || posed[view] ? view : null);
  const shown: Shown = {
    ...{ unit, take: feed.take, player, loop, theme, posed, version: 0, done: false, covariances: NO_COVARIANCES },
    ...selection,
    ...{ through, lookThrough, joined: null, editing: null },
  };
  return { feed, shown, come };
}

/** Looks at what has come a few times a second. */
function useRegularLook(feed: Feed): void {
  const [, look] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => look((looks) => looks + 1), PERIOD_MS);
    return () => clearInterval(timer);
  }, [feed]);
}
