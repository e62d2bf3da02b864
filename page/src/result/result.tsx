/** Loads the result of a fit, and says what goes on or went wrong meanwhile. */

import type { Ref } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import type { Fit } from "../api/resources.ts";
import { loadResult, type Result } from "../data/loading.ts";
import { frameInAddress } from "../route.ts";
import { prepareRenderer } from "./scene/renderer.ts";
import { Workspace } from "./workspace.tsx";

export default function ResultScreen({ fit }: { fit: Fit }) {
  const [result, setResult] = useState<Result | null>(null);
  const placeholder = useRef<HTMLElement>(null);
  const [trouble, setTrouble] = useState<string | null>(null);
  useEffect(() => {
    let current = true;
    setResult(null);
    setTrouble(null);
    const prepare = () => placeholder.current !== null && prepareRenderer(placeholder.current);
    loadResult(fit, frameInAddress(), () => setTimeout(prepare)).then(
      (loaded) => current && setResult(loaded),
      (error: Error) => current && setTrouble(error.message),
    );
    return () => {
      current = false;
    };
  }, [fit.id]);
  if (trouble !== null) {
    return (
      <div class="empty panel" role="alert">
        <h2>The result cannot be shown</h2>
        <p>{trouble}</p>
        <button onClick={() => location.reload()}>Try again</button>
      </div>
    );
  }
  if (result === null) return <Placeholder stage={placeholder} />;
  return <Workspace fit={fit} result={result} />;
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
