/** What keys do on the result screen. */

import { isTaken } from "../parts/key_choice.tsx";
import type { Player } from "./player.ts";
import type { Stage } from "./scene/scene.ts";

export const SHORTCUTS: [string, string][] = [
  ["Space", "play or pause"],
  ["← →", "a frame back or on; with Shift ten"],
  ["Home End", "the first or the last frame"],
  ["W", "the next of the worst frames; with Shift the one before"],
  ["1 – 9", "look through a view; Esc leaves it"],
  ["Del Ctrl+Z", "while keypoints are corrected: remove the selected one; undo"],
  ["Esc", "no keypoint is selected any more"],
  ["F", "show the subject"],
  ["C", "show the cameras"],
];

interface Ways {
  player: Player;
  worst: number[];
  views: number;
  stage: () => Stage | null;
  lookThrough(view: number | null): void;
}

/** Listens to keys until what it returns is called. Controls keep those that are theirs. */
export function listenToKeys(ways: Ways): () => void {
  const listen = (event: KeyboardEvent) => {
    if (isTaken(event)) return;
    if (act(event, ways)) event.preventDefault();
  };
  window.addEventListener("keydown", listen);
  return () => window.removeEventListener("keydown", listen);
}

function act(event: KeyboardEvent, { player, worst, views, stage, lookThrough }: Ways): boolean {
  const far = event.shiftKey ? 10 : 1;
  const actions: Record<string, () => void> = {
    " ": () => player.toggle(),
    ArrowLeft: () => player.step(-far),
    ArrowRight: () => player.step(far),
    Home: () => player.show(0),
    End: () => player.show(player.frames - 1),
    w: () => nextWorst(player, worst, event.shiftKey ? -1 : 1),
    f: () => stage()?.frameSubject(),
    c: () => stage()?.frameCameras(),
    Escape: () => lookThrough(null),
  };
  const view = Number(event.key) - 1;
  const action =
    view >= 0 && view < views
      ? () => lookThrough(view)
      : actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  action?.();
  return action !== undefined;
}

export function afterInWorst(player: Player, worst: number[], step: 1 | -1): number | undefined {
  const here = worst.indexOf(player.frame);
  return worst[here < 0 ? 0 : (here + step + worst.length) % worst.length];
}

/** Goes through the worst frames in the order of how bad they are. */
export function nextWorst(player: Player, worst: number[], step: 1 | -1): void {
  const frame = afterInWorst(player, worst, step);
  if (frame === undefined) return; // there are none
  player.playing = false;
  player.show(frame);
}
