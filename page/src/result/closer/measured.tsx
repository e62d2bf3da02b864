/** What is measured of the selected keypoints in the frame that is shown. */

import { useEffect, useRef } from "preact/hooks";
import { nearest, type Take } from "../../data/take.ts";
import { number, plusMinus } from "../../parts/format.ts";
import { angleDeviations, lengthDeviations, ofFrame, type Covariances } from "../../science/covariances.ts";
import { angles, lengths } from "../../science/measures.ts";
import { useShow } from "../show.ts";

export function Measured() {
  const { take, player, loop, unit, selected, version, covariances } = useShow();
  const { known, coming, ask } = covariances;
  const text = useRef<HTMLParagraphElement>(null);
  useEffect(() => (selected.length > 1 ? ask() : undefined), [selected, ask]);
  useEffect(
    () =>
      loop.add(() => {
        if (text.current === null) return;
        const words = measured(take, known, nearest(take, player.frame), selected, unit);
        text.current.textContent =
          coming && selected.length > 1 ? `${words}. How far this may be off is being computed …` : words;
      }),
    [loop, player, take, unit, selected, version, known, coming],
  );
  return <p class="measured" ref={text} />;
}

function measured(
  take: Take,
  covariances: Covariances | null,
  frame: number,
  selected: readonly number[],
  unit: string,
): string {
  const { names, keypoints } = take;
  const size = 3 * keypoints;
  const points = take.points.subarray(frame * size, (frame + 1) * size);
  const known = covariances && ofFrame(covariances, keypoints, frame);
  const [a, b, c] = selected;
  if (a === undefined) return "Two keypoints have a distance, three an angle at the second.";
  if (b === undefined) {
    const place = [...points.subarray(3 * a, 3 * a + 3)].map((value) => number(value));
    const off = take.deviations[frame * keypoints + a]!;
    const doubt = Number.isFinite(off) ? ` It may be off by ${number(off, 2)}.` : "";
    return `${names[a]} is at x ${place[0]}, y ${place[1]}, z ${place[2]} (${unit}).${doubt}`;
  }
  const between = (from: number, to: number) => {
    const off = known === null ? undefined : lengthDeviations(points, known, keypoints, from, to)[0];
    return `${names[from]} – ${names[to]}: ${plusMinus(lengths(points, keypoints, from, to)[0], off)} (${unit})`;
  };
  if (c === undefined) return between(a, b);
  const off = known === null ? undefined : angleDeviations(points, known, keypoints, a, b, c)[0];
  const degrees = plusMinus(angles(points, keypoints, a, b, c)[0], off, "°");
  return `Angle at ${names[b]}, between ${names[a]} and ${names[c]}: ${degrees}. ${between(a, b)}. ${between(b, c)}`;
}
