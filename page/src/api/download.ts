/** Saves what the service exports, as a file. */

import { addressOf, ask } from "./http.ts";
import { currentKey } from "./key.ts";

/** Has the browser fetch a file by itself; with a key, which a link cannot carry, through memory. */
export async function download(path: string, name: string): Promise<void> {
  if (currentKey() === null) {
    save(addressOf(path), name);
    return;
  }
  saveBlob(await (await ask(path)).blob(), name);
}

export function saveBlob(blob: Blob, name: string): void {
  const url = URL.createObjectURL(blob);
  save(url, name);
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

function save(url: string, name: string): void {
  const link = document.createElement("a");
  link.href = url;
  link.download = name;
  link.click();
}
