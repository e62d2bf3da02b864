/** Play, step, speed, loop, and which frame it is. */

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { number, percent } from "../parts/format.ts";
import { Icon } from "../parts/icons.tsx";
import { rateOf } from "../data/capture.ts";
import { ALL } from "../data/take.ts";
import { useShow } from "./show.ts";
import { nextWorst } from "./keys.ts";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];

export function Transport() {
  const { take, player, loop, means, worst, done, trouble, version } = useShow();
  const [, redraw] = useState(0);
  const frame = useRef<HTMLInputElement>(null);
  const facts = useRef<HTMLSpanElement>(null);
  const state = useRef("");

  useEffect(
    () =>
      player.onChange(() => {
        const next = `${player.playing} ${player.speed} ${player.loop}`;
        if (next === state.current) return;
        state.current = next;
        redraw((count) => count + 1);
      }),
    [player],
  );
  useEffect(
    () =>
      loop.add(() => {
        const input = frame.current;
        if (input !== null && document.activeElement !== input) input.value = `${player.frame}`;
        if (facts.current === null) return;
        const time = take.times?.[player.frame] ?? player.frame / player.rate;
        facts.current.textContent = `${time.toFixed(2)} s · error ${number(means[player.frame])} px`;
      }),
    [loop, player, means, take],
  );

  const { known } = rateOf(take);
  return (
    <div class="transport" role="group" aria-label="Playing">
      <button class="icons" onClick={() => player.step(-1)} aria-label="Frame before" title="←">
        <Icon name="back" />
      </button>
      <button
        class="icons primary"
        onClick={() => player.toggle()}
        aria-label={player.playing ? "Pause" : "Play"}
        title="Space"
      >
        <Icon name={player.playing ? "pause" : "play"} />
      </button>
      <button class="icons" onClick={() => player.step(1)} aria-label="Frame after" title="→">
        <Icon name="forward" />
      </button>
      <button
        class="icons"
        aria-pressed={player.loop}
        onClick={() => player.setLoop(!player.loop)}
        aria-label="Loop"
        title="Loop"
      >
        <Icon name="loop" />
      </button>
      <select
        aria-label="Speed"
        value={player.speed}
        onChange={(event) => player.setSpeed(Number(event.currentTarget.value))}
      >
        {SPEEDS.map((speed) => (
          <option key={speed} value={speed}>
            {speed} ×
          </option>
        ))}
      </select>
      <label class="frame">
        frame
        <input
          ref={frame}
          type="number"
          min={0}
          max={take.frames - 1}
          onChange={(event) => player.show(Number(event.currentTarget.value))}
        />
        <span class="quiet">of {take.frames.toLocaleString("en")}</span>
      </label>
      <span class="quiet facts" ref={facts} />
      {!known && (
        <span class="quiet rate" title="The dataset has neither fps nor times.">
          at {player.rate} frames/s, a guess
        </span>
      )}
      {!done && <Fetching version={version} trouble={trouble} />}
      <button class="worst" disabled={worst.length === 0} onClick={() => nextWorst(player, worst, 1)} title="W">
        Next of the worst frames
      </button>
    </div>
  );
}

/** How many of the frames are there. */
function Fetching({ version, trouble }: { version: number; trouble: boolean }) {
  const { there } = useShow().take;
  // eslint-disable-next-line react-hooks/exhaustive-deps -- the version is of what the take's arrays hold
  const share = useMemo(() => [...there].filter((has) => has === ALL).length / there.length, [version]);
  return (
    <span class="quiet rate" role="status">
      {trouble ? "frames cannot be fetched, trying again" : `${percent(share)} of the frames fetched`}
    </span>
  );
}
