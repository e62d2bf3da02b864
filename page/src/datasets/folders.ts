/** Packs files and folders into one zip: thousands of small files would take long one by one. */

import { Zip, ZipDeflate } from "fflate";
import type { Placed } from "./dropping.ts";

export const MOST_APART = 16; // files without folders that are sent one by one
const MOST = 65_000; // files of a zip without extensions of its format
const AT_A_TIME = 128; // files, between which the page goes on
const LEVEL = 1; // of compression: JSON shrinks to a third in little time

const kept = new WeakMap<Placed[], Promise<Blob>>();

/** Whether files are sent in a zip: they are in folders, or many. */
export function arePacked(files: Placed[]): boolean {
  return files.length > MOST_APART || files.some(({ path }) => path.includes("/"));
}

/** Returns a zip of files under their paths; of the same list the same. */
export function packed(files: Placed[]): Promise<Blob> {
  const known = kept.get(files) ?? pack(files);
  kept.set(files, known);
  return known;
}

async function pack(files: Placed[]): Promise<Blob> {
  if (files.length > MOST) {
    throw new Error(`${files.length} files are more than the ${MOST} that are packed: drop a zip of the folders.`);
  }
  const pieces: Uint8Array<ArrayBuffer>[] = [];
  let failed: Error | null = null;
  const zip = new Zip((error, piece) => {
    if (error) failed = error;
    else pieces.push(piece);
  });
  for (let start = 0; start < files.length; start += AT_A_TIME) {
    const some = files.slice(start, start + AT_A_TIME);
    const read = await Promise.all(some.map(({ file }) => file.arrayBuffer()));
    some.forEach(({ path }, at) => {
      const member = new ZipDeflate(path, { level: LEVEL });
      zip.add(member);
      member.push(new Uint8Array(read[at] ?? new ArrayBuffer()), true);
    });
  }
  zip.end();
  if (failed !== null) throw failed as Error;
  return new Blob(pieces, { type: "application/zip" });
}
