/** The errors of all frames: a band to scrub on, and below it keypoint x frame. */

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { keepSize } from "../parts/canvas_size.ts";
import { number, words } from "../parts/format.ts";
import { LEFT_OUT, UNSEEN } from "../science/errors.ts";
import { quantile } from "../science/worst.ts";
import { drawBand, drawHeatMap, heatColours } from "./heat.ts";
import { useShow } from "./show.ts";

const CLEAR = 0.99; // of the errors are within the colours; larger ones have the last colour

const USUAL = 2.5; // times the median: so a capture whose frames are all alike does not look alarming

export function Timeline() {
  const show = useShow();
  const { take, player, loop, means, worst, errors, errorsDone, theme, select, selected } = show;
  const band = useRef<HTMLCanvasElement>(null);
  const map = useRef<HTMLCanvasElement>(null);
  const scrubber = useRef<HTMLInputElement>(null);
  const cursor = useRef<HTMLDivElement>(null);
  const [width, setWidth] = useState(0); // of the band, in its own pixels
  const [under, setUnder] = useState<{ frame: number; keypoint: number } | null>(null);
  const largest = useMemo(
    () => Math.max(quantile(means, CLEAR), USUAL * quantile(means, 0.5), 1e-6),
    [means],
  );
  const largestOfKeypoints = useMemo(() => (errorsDone ? keypointLimit(errors.worst) : 1), [errors, errorsDone]);

  useEffect(() => {
    const canvas = band.current;
    if (canvas === null) return undefined;
    return keepSize(canvas, () => setWidth(canvas.width));
  }, []);

  useEffect(() => {
    const colours = heatColours(matchMedia("(prefers-color-scheme: dark)").matches);
    if (width === 0) return;
    if (band.current !== null) drawBand(band.current, means, largest, colours);
    if (map.current !== null && errorsDone) {
      drawHeatMap(map.current, errors, take.keypoints, Math.min(width, take.frames), largestOfKeypoints, theme, colours);
    }
  }, [width, errorsDone, theme, take]);

  useEffect(
    () =>
      loop.add(() => {
        const share = take.frames > 1 ? (player.frame + 0.5) / take.frames : 0;
        if (cursor.current !== null) cursor.current.style.left = `${100 * share}%`;
        const input = scrubber.current;
        if (input === null) return;
        input.value = `${player.frame}`;
        input.setAttribute("aria-valuetext", `frame ${player.frame}, error ${number(means[player.frame])} pixels`);
      }),
    [loop, player],
  );

  const cellAt = (event: MouseEvent) => {
    const box = (event.currentTarget as HTMLElement).getBoundingClientRect();
    const frame = Math.floor(((event.clientX - box.left) / box.width) * take.frames);
    const keypoint = Math.floor(((event.clientY - box.top) / box.height) * take.keypoints);
    return {
      frame: Math.min(take.frames - 1, Math.max(0, frame)),
      keypoint: Math.min(take.keypoints - 1, Math.max(0, keypoint)),
    };
  };

  return (
    <div class="timeline">
      <div class="axis quiet">
        <span>reprojection error, mean of the views</span>
        <span>up to {number(largest)} px</span>
      </div>
      <div class="columns">
        <div class="band">
          <canvas ref={band} aria-hidden="true" />
          <input
            ref={scrubber}
            type="range"
            min={0}
            max={take.frames - 1}
            step={1}
            aria-label="Frame"
            onInput={(event) => {
              player.playing = false;
              player.show(Number(event.currentTarget.value));
            }}
          />
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
        </div>
        <Ranges />
        <div
          class="map"
          style={{ height: `${mapHeight(take.keypoints)}px` }}
          onMouseMove={(event) => setUnder(cellAt(event))}
          onMouseLeave={() => setUnder(null)}
          onClick={(event) => {
            const cell = cellAt(event);
            player.playing = false;
            player.show(cell.frame);
            select(cell.keypoint);
          }}
        >
          <canvas
            ref={map}
            role="img"
            aria-label={`Errors of ${take.keypoints} keypoints over ${take.frames} frames`}
          />
          {selected !== null && (
            <i
              class="row"
              style={{ top: `${(100 * selected) / take.keypoints}%`, height: `${100 / take.keypoints}%` }}
            />
          )}
        </div>
        <div class="cursor" ref={cursor} />
      </div>
      <div class="axis quiet">
        <span aria-live="off">{under === null ? caption(take.names, selected) : cellText(show, under)}</span>
        <span class="key">
          0 <i class="ramp" /> {errorsDone ? `${number(largestOfKeypoints)} px` : "…"}
          <i class="swatch outlier" /> outlier, left out <i class="swatch unseen-cell" /> not observed
        </span>
      </div>
    </div>
  );
}

/** The frames that findings concern, as a strip between band and heat map. */
function Ranges() {
  const { findings, take, player } = useShow();
  const concerned = findings.flatMap(({ code, severity, frames }) =>
    ((frames ?? []) as [number, number][]).map((range) => ({ code, severity, range })),
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

function caption(names: string[], selected: number | null): string {
  if (selected === null) return "Each row is a keypoint, each column a frame. Click to go there.";
  return `${names[selected]} is marked in all views. Esc ends that.`;
}

function cellText(
  { take, errors }: ReturnType<typeof useShow>,
  { frame, keypoint }: { frame: number; keypoint: number },
): string {
  const error = errors.worst[frame * take.keypoints + keypoint];
  const words =
    error === UNSEEN ? "not observed, inferred" : error === LEFT_OUT ? "outlier, left out" : `${number(error)} px`;
  return `${take.names[keypoint]}, frame ${frame}: ${words}`;
}

function keypointLimit(worst: Float32Array): number {
  const step = Math.max(1, Math.floor(worst.length / 50_000));
  const known: number[] = [];
  for (let at = 0; at < worst.length; at += step) if (worst[at] >= 0) known.push(worst[at]);
  return Math.max(quantile(known, CLEAR), 1e-6);
}

function mapHeight(keypoints: number): number {
  return Math.min(200, Math.max(72, 4 * keypoints));
}
