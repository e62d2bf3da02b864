/** What is measured of the selected keypoints in the frame that is shown. */

import { useEffect, useRef } from "preact/hooks";
import { nearest, type Take } from "../../data/take.ts";
import { number } from "../../parts/format.ts";
import { angles, lengths } from "../../science/measures.ts";
import { useShow } from "../show.ts";

export function Measured() {
  const { take, player, loop, unit, selected, version } = useShow();
  const text = useRef<HTMLParagraphElement>(null);
  useEffect(
    () =>
      loop.add(() => {
        if (text.current === null) return;
        text.current.textContent = measured(take, nearest(take, player.frame), selected, unit);
      }),
    [loop, player, take, unit, selected, version],
  );
  return <p class="measured" ref={text} />;
}

function measured(take: Take, frame: number, selected: readonly number[], unit: string): string {
  const { names, keypoints } = take;
  const size = 3 * keypoints;
  const points = take.points.subarray(frame * size, (frame + 1) * size);
  const [a, b, c] = selected;
  if (a === undefined) return "Two keypoints have a distance, three an angle at the second.";
  if (b === undefined) {
    const place = [...points.subarray(3 * a, 3 * a + 3)].map((value) => number(value));
    const off = take.deviations[frame * keypoints + a]!;
    const known = Number.isFinite(off) ? ` It may be off by ${number(off)}.` : "";
    return `${names[a]} is at x ${place[0]}, y ${place[1]}, z ${place[2]} (${unit}).${known}`;
  }
  const between = (from: number, to: number) =>
    `${names[from]} – ${names[to]}: ${number(lengths(points, keypoints, from, to)[0])} (${unit})`;
  if (c === undefined) return between(a, b);
  const degrees = number(angles(points, keypoints, a, b, c)[0]);
  return `Angle at ${names[b]}, between ${names[a]} and ${names[c]}: ${degrees}°. ${between(a, b)}. ${between(b, c)}`;
}
