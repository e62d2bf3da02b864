/** One fit: its progress while it goes on, its result once it has succeeded, what to do otherwise. */

import { lazy, Suspense } from "preact/compat";
import { useEffect, useMemo, useState } from "preact/hooks";
import { followFit } from "../api/events.ts";
import { Refusal } from "../api/http.ts";
import { getFit, type Fit } from "../api/resources.ts";
import { Tags } from "../lists/tags.tsx";
import { Alert } from "../parts/alert.tsx";
import { DeleteButton, NamedHeading } from "../parts/named.tsx";
import { goTo, linkTo } from "../route.ts";
import { Failure } from "./failure.tsx";
import { Progress } from "./progress.tsx";
import { Status } from "./status.tsx";

const ResultScreen = lazy(() => import("../result/result.tsx"));

export function FitScreen({ id }: { id: string }) {
  const [fit, setFit] = useState<Fit | null>(null);
  const [trouble, setTrouble] = useState<Error | null>(null);
  const [history, setHistory] = useState<Fit[]>([]);

  useEffect(() => {
    setFit(null);
    setHistory([]);
    let stop = () => {};
    let current = true;
    getFit(id).then(
      (found) => {
        if (!current) return;
        setFit(found);
        if (!isGoingOn(found)) return;
        stop = followFit(
          id,
          (next) => {
            setFit(next);
            setHistory((before) => [...before, next]);
          },
          setTrouble,
        );
      },
      (error: Error) => current && setTrouble(error),
    );
    return () => {
      current = false;
      stop();
    };
  }, [id]);

  const answered = fit?.status === "succeeded" || fit?.answer_stage === "geometry";
  // Progress changes nothing of what is shown of its answer.
  // eslint-disable-next-line react-hooks/exhaustive-deps -- these are what changes of an answer
  const answer = useMemo(() => fit, [fit?.id, fit?.name, fit?.status, fit?.answer_stage]);

  useEffect(() => {
    document.title = `${fit?.name ?? "Fit"} · Fewview`;
  }, [fit?.name]);

  if (fit === null) {
    if (trouble === null) return <div class="waiting-page quiet">Loading …</div>;
    const missing = trouble instanceof Refusal && trouble.status === 404;
    return (
      <div class="empty panel" role="alert">
        <h2>{missing ? "There is no such fit" : "The fit cannot be shown"}</h2>
        <p>{trouble.message}</p>
        <a class="button" href={linkTo()}>
          All fits
        </a>
      </div>
    );
  }
  return (
    <main class={answered ? "wide" : ""}>
      <header class="title">
        <NamedHeading kind="fits" id={fit.id} name={fit.name} onName={(name) => setFit({ ...fit, name })} />
        <Status fit={fit} />
        <span class="quiet id">
          {fit.id} · <a href={linkTo("datasets", fit.dataset_id)}>its dataset</a>
          {fit.model_id && (
            <>
              {" "}
              · <a href={linkTo("models", fit.model_id)}>its model</a>
            </>
          )}
        </span>
      </header>
      <Tags key={fit.id} kind="fits" id={fit.id} tags={fit.tags} />
      {isGoingOn(fit) && <Alert>{trouble && `${trouble.message} Trying again.`}</Alert>}
      {isGoingOn(fit) && <Progress fit={fit} history={history} onFit={setFit} />}
      {(fit.status === "failed" || fit.status === "cancelled") && <Failure fit={fit} />}
      {answered && answer !== null && (
        <Suspense fallback={<div class="waiting-page quiet">Loading …</div>}>
          <ResultScreen fit={answer} />
        </Suspense>
      )}
      {!isGoingOn(fit) && <DeleteButton kind="fits" id={fit.id} what="this fit" onDeleted={() => goTo()} />}
    </main>
  );
}

export function isGoingOn(fit: Fit): boolean {
  return fit.status === "queued" || fit.status === "running";
}
