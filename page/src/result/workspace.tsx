/** The result screen: the structure, the views, the errors in time, and what was noticed. */

import type { ComponentChildren } from "preact";
import { useEffect, useState } from "preact/hooks";
import type { Fit } from "../api/resources.ts";
import type { Axes, Result } from "../data/loading.ts";
import { Icon } from "../parts/icons.tsx";
import { FindingList } from "../parts/finding_list.tsx";
import { Verdict } from "../parts/verdict.tsx";
import { Closer } from "./closer/closer.tsx";
import { CorrectPanel } from "./correcting/correct_panel.tsx";
import { CopyLink, Shortcuts, WorstFrames } from "./asides.tsx";
import type { Crop } from "./crop.ts";
import { Exports } from "./exports.tsx";
import { Figures } from "./figures.tsx";
import { Labels } from "./labels.tsx";
import { Legend } from "./legend.tsx";
import type { Player } from "./player.ts";
import { ReportLink } from "./report_link.tsx";
import type { Stage } from "./scene/scene.ts";
import { KnownPanel } from "../remedies/known_panel.tsx";
import { Remediable } from "../remedies/provider.tsx";
import { SkeletonPanel } from "../remedies/skeleton_panel.tsx";
import { useSubjectOf } from "../remedies/use_subject_of.ts";
import { ShowContext, ShownContext, type Show } from "./show.ts";
import { Timeline } from "./timeline.tsx";
import { Transport } from "./transport.tsx";
import { TwoStages } from "./two_stages.tsx";
import { useResult } from "./use_result.ts";
import { ViewPanel } from "./view_panel.tsx";

/** What is played at the moment, and from where it is seen. */
export interface Playing {
  player: Player;
  stage: Stage | null;
}

interface Props {
  fit: Fit;
  result: Result;
  first: number; // frame that is shown
  playing: { current: Playing | null }; // goes on where another answer takes the place of the first
  onAgain: (first: number, axes?: Axes) => void; // has the result loaded again
}

export function Workspace({ fit, result, first, playing, onAgain }: Props) {
  const [stage, setStage] = useState<Stage | null>(null);
  const [crop, setCrop] = useState<Crop>("subject");
  const [before] = useState(() => playedBefore(playing.current));
  const show = useResult(fit, result, before?.frame ?? first, stage);
  const { take, player, findings } = show;
  const isFirst = result.model === null;
  useEffect(() => {
    if (before !== null) goOn(player, before);
    // eslint-disable-next-line react-hooks/exhaustive-deps -- once, as it begins
  }, []);
  useEffect(() => {
    if (stage !== null && before?.angle) stage.setAngle(before.angle);
    // eslint-disable-next-line react-hooks/exhaustive-deps -- once, as it can be seen
  }, [stage]);
  useEffect(() => {
    playing.current = { player, stage };
  }, [playing, player, stage]);
  const subject = useSubjectOf(fit, {
    ...{ take, file: show.file, selected: show.selected.at(-1) ?? null, onEdges: show.join },
    lifting: { frame: take.frame === "view" ? "canonical" : "room" },
    onLifting: (axes) => onAgain(player.frame, axes),
  });
  return (
    <Both show={show}>
      <div class="result" aria-busy={!show.done}>
        {isFirst && (
          <p class="verdict caution" role="status">
            <Icon name="warning" /> <strong>This is the first answer,</strong> of the cameras that geometry found. The
            network is still being taught; its answer takes this one&apos;s place when the fit ends.
          </p>
        )}
        <Verdict verdict={fit.verdict} framesDoubted={findings.length > fit.findings.length}>
          {fit.verdict?.expected && (
            <>
              {" "}
              <ReportLink fit={fit.id} />
            </>
          )}
        </Verdict>
        <div class="screens">
          <TwoStages stage={stage} onStage={setStage} />
          <section class="views" aria-label="Views" data-count={take.views}>
            {take.viewNames.map((_, view) => (
              <ViewPanel key={view} view={view} crop={crop} />
            ))}
          </section>
        </div>
        <section class="panel playing" aria-label="Time">
          <Transport />
          <Timeline />
          <Legend crop={crop} setCrop={setCrop} />
        </section>
        {!isFirst && <CorrectPanel />}
        {!isFirst && <Closer />}
        <div class="facts-grid">
          <div class="stack">
            <section class="panel">
              <h2>What was noticed</h2>
              <WorstFrames />
              <Remediable subject={subject}>
                <FindingList
                  findings={findings}
                  viewNames={take.viewNames}
                  keypointNames={take.names}
                  onFrame={(frame) => player.show(frame)}
                  onKeypoint={(keypoint) => show.setSelected([keypoint])}
                />
              </Remediable>
            </section>
            {subject !== null && (
              <Remediable subject={subject}>
                <SkeletonPanel onSaved={() => onAgain(player.frame)} />
                <KnownPanel />
              </Remediable>
            )}
          </div>
          <section class="panel">
            <h2>Figures</h2>
            <Figures />
          </section>
          <section class="panel">
            <h2>Take it away</h2>
            <Exports stage={stage} />
            {!isFirst && <Labels />}
            <CopyLink stage={stage} frame={() => player.frame} />
            <Shortcuts />
          </section>
        </div>
      </div>
    </Both>
  );
}

function playedBefore(playing: Playing | null) {
  if (playing === null) return null;
  const { frame, playing: goesOn, speed, loop } = playing.player;
  return { frame, goesOn, speed, loop, angle: playing.stage?.angle() };
}

function goOn(player: Player, { goesOn, speed, loop }: NonNullable<ReturnType<typeof playedBefore>>) {
  player.setSpeed(speed);
  player.setLoop(loop);
  if (goesOn) player.toggle();
}

/** Lets what shows results, and what shows any structures, use them. */
function Both({ show, children }: { show: Show; children: ComponentChildren }) {
  return (
    <ShownContext.Provider value={show}>
      <ShowContext.Provider value={show}>{children}</ShowContext.Provider>
    </ShownContext.Provider>
  );
}
