/** Frames of a stream as they come, and how the stream goes: its own, or one that is watched. */

import type { Take } from "../data/take.ts";
import type { Trouble } from "./connection.ts";

/** How a stream went in one second. */
export interface Second {
  at: number; // seconds, of the browser's clock
  median: number | null; // milliseconds until an answer; null where there was none
  p95: number | null;
}

export interface Figures {
  connected: boolean;
  answered: number; // frames, as are the following
  dropped: number;
  notLifted: number;
  refused: number;
  perSecond: number; // answers
  seconds: Second[]; // the last of them
  sent?: number; // frames, where that is known
}

export interface Feed {
  take: Take;
  figures: Figures;
  stop(): void;
}

export interface Listener {
  /** Called with the frame of the take that each answer was put into. */
  onFrame(frame: number): void;
  onTrouble(trouble: Trouble): void;
  onReady(): void;
}

const SECONDS = 120; // that are kept

export function noFigures(): Figures {
  return { connected: false, answered: 0, dropped: 0, notLifted: 0, refused: 0, perSecond: 0, seconds: [] };
}

export function noteSecond({ seconds }: Figures, median: number | null, p95: number | null): void {
  const at = performance.now() / 1000;
  if (at - (seconds.at(-1)?.at ?? -1) < 0.5) return; // it is the same second
  seconds.push({ at, median, p95 });
  if (seconds.length > SECONDS) seconds.shift();
}
