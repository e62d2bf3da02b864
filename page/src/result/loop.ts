/** Draws when the browser is about to show a picture, and only what has changed. */

import type { Player } from "./player.ts";

export interface Loop {
  /** Adds what is drawn when the frame changes or somebody wakes the loop; returns what ends it. */
  add(draw: () => void): () => void;
  /** Adds what looks for itself whether there is anything to draw. */
  addAlways(draw: () => void): () => void;
  wake(): void;
  close(): void;
}

const LONGEST_STEP = 0.25; // seconds: a tab that was hidden goes on where it was

export function createLoop(player: Player): Loop {
  const drawings = new Set<() => void>();
  const always = new Set<() => void>();
  let dirty = true;
  let last = performance.now();
  const stopListening = player.onChange(() => {
    dirty = true;
  });
  const draw = (now: number) => {
    player.advance(Math.min(LONGEST_STEP, (now - last) / 1000));
    last = now;
    for (const each of always) each();
    if (dirty) {
      dirty = false;
      for (const each of drawings) each();
    }
    request = requestAnimationFrame(draw);
  };
  let request = requestAnimationFrame(draw);
  const addTo = (set: Set<() => void>) => (each: () => void) => {
    set.add(each);
    dirty = true;
    return () => void set.delete(each);
  };
  return {
    add: addTo(drawings),
    addAlways: addTo(always),
    wake() {
      dirty = true;
    },
    close() {
      cancelAnimationFrame(request);
      stopListening();
    },
  };
}
