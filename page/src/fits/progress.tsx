/** How far a fit has come: a bar, figures, and the reprojection error as it falls. */

import { useEffect, useState } from "preact/hooks";
import { cancelFit, type Fit, type FitSchedule, getSchedule } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";
import { count, duration, number, pixels } from "../parts/format.ts";
import { Curve } from "./curve.tsx";

export function Progress({ fit, history, onFit }: { fit: Fit; history: Fit[]; onFit: (fit: Fit) => void }) {
  const [trouble, setTrouble] = useState<string | null>(null);
  const progress = fit.progress;
  const share = progress ? progress.step / Math.max(1, progress.steps) : 0;
  const rows = history.flatMap(({ progress: each }) =>
    each?.reprojection_error ? [{ step: each.step, error: each.reprojection_error }] : [],
  );
  return (
    <section class="panel progress-panel">
      <div class="progress-line">
        <strong>{stageOf(fit)}</strong>
        <span class="quiet">
          {progress && `step ${number(progress.step)} of ${number(progress.steps)}`}
          {progress?.seconds_left ? ` · about ${duration(progress.seconds_left)} left` : ""}
          {fit.status === "queued" && <Schedule id={fit.id} />}
        </span>
      </div>
      <progress max={1} {...(progress ? { value: share } : {})} aria-label="Progress of the fit" />
      <Curve rows={rows} steps={progress?.steps ?? 1} />
      <div class="progress-line">
        <span class="quiet">
          reprojection error {pixels(progress?.reprojection_error)} · {fit.frames.toLocaleString("en")} frames
        </span>
        <button
          disabled={fit.cancel_requested}
          onClick={() => void cancelFit(fit.id).then(onFit, (error: Error) => setTrouble(error.message))}
        >
          Cancel the fit
        </button>
      </div>
      <Alert>{trouble}</Alert>
      <p class="quiet">You may close this page: the fit goes on, and its result will be here.</p>
    </section>
  );
}

const ASK_EVERY = 5000; // milliseconds

/** When a fit that waits is expected to start and to end. */
function Schedule({ id }: { id: string }) {
  const [known, setKnown] = useState<FitSchedule | null>(null);
  useEffect(() => {
    const ask = () => void getSchedule(id).then(setKnown, () => setKnown(null)); // it is asked again
    ask();
    const timer = setInterval(ask, ASK_EVERY);
    return () => clearInterval(timer);
  }, [id]);
  if (known === null || known.status !== "queued") return null;
  const at = (moment: string) => new Date(moment).toLocaleTimeString("en", { hour: "2-digit", minute: "2-digit" });
  return (
    <>
      {known.workers === 0 ? "no worker is there for it" : `${count(known.ahead, "fit")} ahead`}
      {known.expected_start && ` · starts at about ${at(known.expected_start)}`}
      {known.expected_end && `, ends at about ${at(known.expected_end)}`}
    </>
  );
}

function stageOf(fit: Fit): string {
  if (fit.status === "queued") return "Waiting for a worker";
  if (fit.progress === null || fit.progress === undefined) return "Starting";
  return fit.progress.stage === "refining" ? "Estimating cameras and refining frames" : "Training";
}
