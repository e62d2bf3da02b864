/** What a stream brings: the structure, the views, how fast answers come, and what was noticed. */

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type { ModelSummary } from "../api/resources.ts";
import type { CaptureFile } from "../data/capture.ts";
import type { Frame } from "../data/take.ts";
import { FigureList } from "../parts/figure_list.tsx";
import { FindingList } from "../parts/finding_list.tsx";
import { count, number } from "../parts/format.ts";
import { onThemeChange, readTheme } from "../parts/theme.ts";
import { createLoop } from "../result/loop.ts";
import { createPlayer } from "../result/player.ts";
import type { Extent } from "../result/scene/parts.ts";
import { ShownContext, type Shown } from "../result/show.ts";
import { StagePanel } from "../result/stage_panel.tsx";
import { ViewPanel } from "../result/view_panel.tsx";
import { frameFindings } from "../science/frame_findings.ts";
import { quantile } from "../science/worst.ts";
import { startReplay, type Figures, type Replay } from "./replay.ts";
import type { Trouble } from "./stream.ts";

/** What is streamed, and how. */
export interface Running {
  model: ModelSummary;
  file: CaptureFile;
  frame: Frame;
  posed: boolean[];
  extent?: Extent; // of the subject; without one it is that of the first answers
  rate: number;
}

const FIRST_ANSWERS = 30;
const PERIOD_MS = 250; // between two looks at the figures

export function LivePanels({ running }: { running: Running }) {
  const [trouble, setTrouble] = useState<Trouble | null>(null);
  const { replay, shown: begun } = useReplay(running, setTrouble);
  const figures = useFigures(replay);
  const ready = running.extent !== undefined ? figures.answered > 0 : figures.answered >= FIRST_ANSWERS;
  const { take } = replay;
  const shown: Shown = { ...begun, done: ready };
  return (
    <ShownContext.Provider value={shown}>
      {trouble !== null && (
        <p class="trouble" role="alert">
          {trouble.reason} {!trouble.forGood && "Trying again."}
        </p>
      )}
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
          </section>
          <section class="panel">
            <h2>What was noticed</h2>
            <FindingList
              findings={frameFindings(take.frameBits)}
              viewNames={take.viewNames}
              keypointNames={take.names}
            />
          </section>
        </div>
      </div>
    </ShownContext.Provider>
  );
}

function StreamFigures({ figures, rate }: { figures: Figures; rate: number }) {
  const { connected, sent, answered, dropped, notLifted, latencies, perSecond } = figures;
  const rows: [string, string][] = [
    ["Connection", connected ? "open" : "broken"],
    ["An answer takes", `${number(quantile(latencies, 0.5))} ms in the median, ${number(quantile(latencies, 0.95))} ms at p95`],
    ["Answers", `${number(perSecond)} a second, of ${number(rate)} frames a second`],
    ["Sent", `${count(sent, "frame")}, ${answered.toLocaleString("en")} answered`],
    ["Dropped", count(dropped, "frame")],
    ["Not lifted", count(notLifted, "frame")],
  ];
  return <FigureList rows={rows} />;
}

/** Streams as long as the screen is there. */
function useReplay(running: Running, setTrouble: (trouble: Trouble | null) => void) {
  const { model, file, frame, posed, rate } = running;
  const [theme, setTheme] = useState(readTheme);
  const [through, setThrough] = useState<number | null>(null);
  const [selected, select] = useState<number | null>(null);
  const player = useMemo(() => createPlayer(file.capture.frames, rate, 0), [running]);
  const loop = useMemo(() => createLoop(player), [player]);
  const replay = useMemo(
    () =>
      startReplay(file, model.id, frame, rate, {
        onFrame(shownFrame) {
          player.show(shownFrame);
          loop.wake();
        },
        onTrouble: setTrouble,
        onReady: () => setTrouble(null),
      }),
    [running],
  );
  useEffect(
    () => () => {
      replay.stop();
      loop.close();
    },
    [replay, loop],
  );
  useEffect(() => onThemeChange(() => setTheme(readTheme())), []);
  const lookThrough = (view: number | null) => setThrough(view === null || posed[view] ? view : null);
  const shown: Shown = {
    ...{ config: model.config, take: replay.take, player, loop, theme, posed, version: 0, done: false },
    ...{ selected, select, through, lookThrough },
  };
  return { replay, shown };
}

/** Returns what has come so far, looked at a few times a second. */
function useFigures(replay: Replay): Figures {
  const [, look] = useState(0);
  const parts = useRef(0);
  useEffect(() => {
    const timer = setInterval(() => look(++parts.current), PERIOD_MS);
    return () => clearInterval(timer);
  }, [replay]);
  return replay.figures;
}
