/** Fits the same capture again, with one thing changed and all else as before. */

import { useState } from "preact/hooks";
import { createFit, type Fit } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";
import { goTo } from "../route.ts";
import { Choice } from "./choice.tsx";
import { useSubject } from "./subject.ts";
import { useAttempt } from "./use_attempt.ts";

/** Queues a fit like another, and returns it. */
export function fitLike(fit: Fit, change: Record<string, unknown>): Promise<Fit> {
  const { dataset_id, name, tags, config, from_model } = fit;
  return createFit({ dataset_id, name, tags, config: { ...config, ...change }, ...(from_model && { from_model }) });
}

interface FitAgainProps {
  change: Record<string, unknown> | null; // of the configuration; null as long as it is not complete
  words?: string; // on the button
}

export function FitAgain({ change, words = "Fit again with it" }: FitAgainProps) {
  const { fit } = useSubject();
  const { busy, trouble, attempt } = useAttempt();
  if (fit === null) return null;
  const go = () => attempt(async () => goTo("fits", (await fitLike(fit, change ?? {})).id));
  return (
    <>
      <Alert>{trouble}</Alert>
      <div class="buttons">
        <button class="primary" disabled={busy || change === null} onClick={go}>
          {words}
        </button>
        <span class="quiet">All else stays as it is. This fit stays, too.</span>
      </div>
    </>
  );
}

interface OneOfProps {
  label: string;
  choices: readonly (readonly [string, string])[]; // values of a setting, and their words
  before: string;
  changeTo: (value: string) => Record<string, unknown>;
}

/** A setting of the fit that is one of a few. */
export function OneOf({ label, choices, before, changeTo }: OneOfProps) {
  const [value, setValue] = useState(before);
  return (
    <>
      <label>
        {label} <Choice value={value} choices={choices} onChange={setValue} />
      </label>
      <FitAgain change={value === before ? null : changeTo(value)} />
    </>
  );
}
