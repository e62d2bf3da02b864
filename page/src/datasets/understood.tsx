/** What was understood of a capture: in words, and as each view shows a frame of it. */

import { useEffect, useRef } from "preact/hooks";
import type { Dataset, DatasetPreview } from "../api/resources.ts";
import { FindingList } from "../parts/finding_list.tsx";
import { percent } from "../parts/format.ts";
import { drawKeypoints, type Drawn } from "./preview.ts";

const MOST_MISSING = 0.9; // share of a view's keypoints beyond which that is no good news

/** @param frame what is drawn; null while it is not there yet */
export function Understood({ facts, frame }: { facts: Dataset | DatasetPreview; frame: Drawn | null }) {
  const holder = useRef<HTMLDivElement>(null);
  useEffect(() => {
    if (frame === null || holder.current === null) return;
    [...holder.current.querySelectorAll("canvas")].forEach((canvas, view) => drawKeypoints(canvas, frame, view));
  }, [frame]);
  return (
    <>
      {facts.notes.length > 0 && (
        <ul class="notes">
          {facts.notes.map((note) => (
            <li key={note}>{note}</li>
          ))}
        </ul>
      )}
      <div class="previews" ref={holder}>
        {facts.missing_fraction.map((missing, view) => (
          <figure key={view}>
            <canvas role="img" aria-label={`A frame of view ${view}`} />
            <figcaption>
              {facts.view_names?.[view] ?? `view ${view}`} <span class="quiet">{percent(1 - missing)} observed</span>
            </figcaption>
          </figure>
        ))}
      </div>
      <FindingList
        findings={facts.findings}
        calm={facts.notes.length === 0 && facts.missing_fraction.every((missing) => missing < MOST_MISSING)}
        viewNames={facts.view_names ?? undefined}
        keypointNames={facts.skeleton?.keypoint_names ?? undefined}
      />
    </>
  );
}
