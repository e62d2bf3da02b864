/** The key that requests carry, kept for as long as the browser's tab is open. */

const PLACE = "fewview-key";
const askers = new Set<() => void>();

export function currentKey(): string | null {
  return sessionStorage.getItem(PLACE);
}

export function keepKey(key: string): void {
  sessionStorage.setItem(PLACE, key);
}

/** Calls a function whenever a request was refused for want of a key; returns what stops that. */
export function onKeyNeeded(ask: () => void): () => void {
  askers.add(ask);
  return () => askers.delete(ask);
}

export function askForKey(): void {
  sessionStorage.removeItem(PLACE);
  for (const ask of askers) ask();
}
