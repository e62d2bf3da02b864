/** Where on a screen one was: a new screen begins at its top, and one that is come back to where it was left. */

import { unique } from "./parts/unique.ts";

const PATIENCE_MS = 2000; // for a screen to get as long as it was

/** Keeps the places of screens until what it returns is called. */
export function keepPlaces(): () => void {
  const places = new Map<string, number>();
  let here = entry();
  let path = pathNow();
  let going = 0; // the frame in which the page is scrolled next; 0: it is where it should be
  history.scrollRestoration = "manual";
  const stopGoing = () => {
    cancelAnimationFrame(going);
    going = 0;
  };
  const goTo = (place: number) => {
    const until = performance.now() + PATIENCE_MS;
    const go = () => {
      window.scrollTo(0, place);
      const short = Math.abs(window.scrollY - place) > 1;
      going = short && performance.now() < until ? requestAnimationFrame(go) : 0;
    };
    stopGoing();
    go();
  };
  const note = () => {
    if (going === 0) places.set(here, window.scrollY);
  };
  const move = () => {
    const known = places.get(entryNow() ?? "");
    here = entry();
    if (pathNow() === path && known === undefined) return;
    path = pathNow();
    goTo(known ?? 0);
  };
  const listeners: [string, () => void][] = [
    ["scroll", note],
    ["hashchange", move],
    ["wheel", stopGoing],
    ["touchstart", stopGoing],
    ["keydown", stopGoing],
  ];
  for (const [name, listener] of listeners) window.addEventListener(name, listener, { passive: true });
  return () => {
    stopGoing();
    for (const [name, listener] of listeners) window.removeEventListener(name, listener);
  };
}

/** Returns the mark of the entry of the browser's history that is shown, and marks a new one. */
function entry(): string {
  const known = entryNow();
  if (known !== null) return known;
  const mark = unique();
  history.replaceState({ entry: mark }, "");
  return mark;
}

function entryNow(): string | null {
  return (history.state as { entry?: string } | null)?.entry ?? null;
}

function pathNow(): string {
  return location.hash.split("?")[0] ?? "";
}
