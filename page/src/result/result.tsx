/** Loads the result of a fit, and says what goes on or went wrong meanwhile. */

import type { Ref } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import type { Fit } from "../api/resources.ts";
import { loadResult, Unplayable, type Axes, type Result } from "../data/loading.ts";
import { Downloads } from "../parts/downloads.tsx";
import { FindingList } from "../parts/finding_list.tsx";
import { frameInAddress } from "../route.ts";
import { structuresOf } from "./exports.tsx";
import { prepareRenderer } from "./scene/renderer.ts";
import { Workspace, type Playing } from "./workspace.tsx";

export default function ResultScreen({ fit }: { fit: Fit }) {
  const [result, setResult] = useState<Result | null>(null);
  const [wanted, setWanted] = useState<Wanted>({ first: frameInAddress(), axes: {} });
  const placeholder = useRef<HTMLElement>(null);
  const shown = useRef<{ id: string; wanted: Wanted } | null>(null);
  const playing = useRef<Playing | null>(null);
  const [trouble, setTrouble] = useState<Error | null>(null);
  useEffect(() => {
    let current = true;
    // A first answer is shown until the one that takes its place is there.
    if (shown.current?.id !== fit.id || shown.current.wanted !== wanted) {
      setResult(null);
      playing.current = null;
    }
    shown.current = { id: fit.id, wanted };
    setTrouble(null);
    const prepare = () => placeholder.current !== null && prepareRenderer(placeholder.current);
    loadResult(fit, wanted.first, wanted.axes, () => setTimeout(prepare)).then(
      (loaded) => current && setResult(loaded),
      (error: Error) => current && setTrouble(error),
    );
    return () => {
      current = false;
    };
    // eslint-disable-next-line react-hooks/exhaustive-deps -- what else changes of a fit is its name
  }, [fit.id, fit.answer_stage, wanted]);
  if (trouble instanceof Unplayable) return <Remains fit={fit} why={trouble.message} />;
  if (trouble !== null) {
    return (
      <div class="empty panel" role="alert">
        <h2>The result cannot be shown</h2>
        <p>{trouble.message}</p>
        <button onClick={() => location.reload()}>Try again</button>
      </div>
    );
  }
  if (result === null) return <Placeholder stage={placeholder} />;
  const again = (first: number, axes = wanted.axes) => setWanted({ first, axes });
  const answer = result.model === null ? "first" : "last";
  return <Workspace key={answer} fit={fit} result={result} first={wanted.first} playing={playing} onAgain={again} />;
}

/** What is loaded; another object has it loaded again. */
interface Wanted {
  first: number; // frame that is shown
  axes: Axes;
}

/** What is left of a result that cannot be played, to be saved. */
function Remains({ fit, why }: { fit: Fit; why: string }) {
  return (
    <section class="panel" aria-label="What is left">
      <h2>This result can no longer be played</h2>
      <p>{why} What is left of it:</p>
      <Downloads groups={[["Structures and cameras of every frame", structuresOf(fit)]]} />
      <FindingList findings={fit.findings} />
    </section>
  );
}

/** Takes the space that the result will have, so that nothing jumps. */
function Placeholder({ stage }: { stage: Ref<HTMLElement> }) {
  return (
    <div class="result" aria-busy="true">
      <div class="screens">
        <section class="panel stage waiting" ref={stage}>
          <p class="quiet">Loading the structures …</p>
        </section>
        <section class="views">
          <div class="panel view waiting" />
          <div class="panel view waiting" />
        </section>
      </div>
      <section class="panel playing waiting" />
    </div>
  );
}
