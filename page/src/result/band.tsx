/** The mean error of each frame as a band, on which one scrubs; the worst frames are marked. */

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { keepSize } from "../parts/canvas_size.ts";
import { number, words } from "../parts/format.ts";
import { quantile } from "../science/worst.ts";
import { drawBand, heatColours, isDark } from "./heat.ts";
import { useShow } from "./show.ts";

const CLEAR = 0.99; // of the frames are within the band; worse ones fill it
const USUAL = 2.5; // times the median: so a capture whose frames are all alike does not look alarming

/** Returns the error that fills the band, in pixels. */
export function bandLimit(means: Float32Array): number {
  return Math.max(quantile(means, CLEAR), USUAL * quantile(means, 0.5), 1e-6);
}

export function Band() {
  const { take, player, loop, means, theme } = useShow();
  const canvas = useRef<HTMLCanvasElement>(null);
  const scrubber = useRef<HTMLInputElement>(null);
  const [width, setWidth] = useState(0); // in the canvas's own pixels
  const largest = useMemo(() => bandLimit(means), [means]);

  useEffect(() => {
    const element = canvas.current;
    return element === null ? undefined : keepSize(element, () => setWidth(element.width));
  }, []);
  useEffect(() => {
    if (width > 0 && canvas.current !== null) drawBand(canvas.current, means, largest, heatColours(isDark()));
  }, [width, theme, means, largest]);
  useEffect(
    () =>
      loop.add(() => {
        const input = scrubber.current;
        if (input === null) return;
        input.value = `${player.frame}`;
        input.setAttribute("aria-valuetext", `frame ${player.frame}, error ${number(means[player.frame])} pixels`);
      }),
    [loop, player, means],
  );
  return (
    <div class="band">
      <canvas ref={canvas} aria-hidden="true" />
      <input
        ref={scrubber}
        type="range"
        data-frames
        min={0}
        max={take.frames - 1}
        step={1}
        aria-label="Frame"
        onInput={(event) => {
          player.playing = false;
          player.show(Number(event.currentTarget.value));
        }}
      />
      <Worst />
    </div>
  );
}

function Worst() {
  const { take, player, means, worst } = useShow();
  return (
    <div class="marks">
      {worst.map((frame, rank) => (
        <button
          key={frame}
          style={{ left: `${(100 * (frame + 0.5)) / take.frames}%` }}
          onClick={() => player.show(frame)}
          aria-label={`Frame ${frame}, number ${rank + 1} of the worst: ${number(means[frame])} pixels`}
          title={`Frame ${frame}: ${number(means[frame])} px`}
        />
      ))}
    </div>
  );
}

/** The frames that findings concern, as a strip. */
export function Ranges() {
  const { findings, take, player } = useShow();
  const concerned = findings.flatMap(({ code, severity, frames }) =>
    (frames ?? []).map((range) => ({ code, severity, range })),
  );
  if (concerned.length === 0) return null;
  return (
    <div class="ranges">
      {concerned.map(({ code, severity, range: [first, last] }, index) => (
        <button
          key={index}
          class={severity}
          style={{ left: `${(100 * first) / take.frames}%`, width: `${(100 * (last - first + 1)) / take.frames}%` }}
          onClick={() => player.show(first)}
          aria-label={`${words(code)}: frames ${first} to ${last}`}
          title={`${words(code)}: frames ${first} to ${last}`}
        />
      ))}
    </div>
  );
}
