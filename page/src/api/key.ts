/** The key that requests carry, kept for as long as the browser's tab is open.
 *
 * In a browser of the service's own user it comes with the address, `#key=TOKEN`, which `fewview serve` prints. */

const PLACE = "fewview-key";
const askers = new Set<() => void>();

export function currentKey(): string | null {
  return sessionStorage.getItem(PLACE);
}

export function keepKey(key: string): void {
  sessionStorage.setItem(PLACE, key);
}

/** Keeps the key that the address has, and takes it out of the address; returns whether there was one. */
export function takeKeyFromAddress(): boolean {
  const [, key, screen = ""] = /^#key=([\w-]+)(.*)$/.exec(location.hash) ?? [];
  if (key === undefined) return false;
  keepKey(key);
  history.replaceState(null, "", `#${screen}`);
  return true;
}

/** Returns the key that somebody has pasted, be it with the address that has it. */
export function keyIn(text: string): string {
  return /#key=([\w-]+)/.exec(text)?.[1] ?? text.trim();
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
