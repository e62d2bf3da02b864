/** The errors of all frames: a band to scrub on, and below it keypoint x frame. */

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { number } from "../parts/format.ts";
import { Band, bandLimit, Ranges } from "./band.tsx";
import { cellText, HeatKey, HeatMap, type Cell } from "./heat_map.tsx";
import { useShow } from "./show.ts";
import { useHeat } from "./use_heat.ts";

export function Timeline() {
  const show = useShow();
  const { take, player, loop, means, selected } = show;
  const heat = useHeat(show);
  const cursor = useRef<HTMLDivElement>(null);
  const [under, setUnder] = useState<Cell | null>(null);
  const largest = useMemo(() => bandLimit(means), [means]);
  useEffect(
    () =>
      loop.add(() => {
        const share = take.frames > 1 ? (player.frame + 0.5) / take.frames : 0;
        if (cursor.current !== null) cursor.current.style.left = `${100 * share}%`;
      }),
    [loop, player, take],
  );
  return (
    <div class="timeline">
      <div class="axis quiet">
        <span>reprojection error, mean of the views</span>
        <span>up to {number(largest)} px</span>
      </div>
      <div class="columns">
        <Band />
        <Ranges />
        <HeatMap heat={heat} onCell={setUnder} />
        <div class="cursor" ref={cursor} />
      </div>
      <div class="axis quiet">
        <span>{under === null ? caption(take.names, selected) : cellText(show, heat, under)}</span>
        <HeatKey heat={heat} />
      </div>
    </div>
  );
}

function caption(names: readonly string[], selected: readonly number[]): string {
  if (selected.length === 0) return "Each row is a keypoint, each column a frame. Click to go there.";
  const marked = selected.map((keypoint) => names[keypoint]).join(", ");
  return `${marked} ${selected.length === 1 ? "is" : "are"} marked in all views. Esc ends that.`;
}
