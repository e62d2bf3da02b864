/** Sends corrections to the service in the order in which they were made, one request at a time: what is made
 * meanwhile goes together in the next. */

import { Refusal } from "../../api/http.ts";
import { correctKeypoints, readCorrections, type DatasetCorrections } from "../../api/resources.ts";
import { keyOf, placeOf, type Place, type Position } from "../../data/corrections.ts";

/** A keypoint that is to be somewhere, nowhere (null), or where it was detected (undefined). */
export interface Change {
  place: Place;
  position: Position | null | undefined;
}

/** Corrections of a dataset that somebody else changed meanwhile. */
export class Overtaken extends Error {
  readonly now: DatasetCorrections;

  constructor(now: DatasetCorrections) {
    super("Somebody else corrected keypoints meanwhile. Theirs are shown now, and your last change was not saved.");
    this.now = now;
  }
}

export interface Saver {
  /** Saves a change after those before it, and returns the checksum of all corrections then. */
  save(change: Change): Promise<string | null>;
}

interface Waiting {
  change: Change;
  resolve(checksum: string | null): void;
  reject(error: Error): void;
}

/** @param known the checksum of the corrections that the page has
 * @param tag of the dataset when it was read */
export function createSaver(dataset: string, known: string | null, tag: string | null): Saver {
  let waiting: Waiting[] = [];
  let sending = false;

  async function send(changes: Change[]): Promise<string | null> {
    const last = [...new Map(changes.map((each) => [keyOf(each.place), each])).values()]; // of each place
    const change = {
      undo: last.flatMap(({ place, position }) => (position === undefined ? [placeOf(place)] : [])),
      correct: last.flatMap(({ place, position }) => (position === undefined ? [] : [{ ...placeOf(place), position }])),
    };
    for (;;) {
      try {
        const answer = await correctKeypoints(dataset, change, tag);
        [known, tag] = [answer.found.checksum, answer.tag];
        return known;
      } catch (error) {
        if (!(error instanceof Refusal) || error.status !== 412) throw error;
        const now = await readCorrections(dataset);
        const others = now.found.checksum !== known; // else something else of the dataset has changed
        [known, tag] = [now.found.checksum, now.tag];
        if (others) throw new Overtaken(now.found);
      }
    }
  }

  async function sendAll(): Promise<void> {
    sending = true;
    while (waiting.length > 0) {
      const now = waiting;
      waiting = [];
      await send(now.map(({ change }) => change)).then(
        (checksum) => now.forEach(({ resolve }) => resolve(checksum)),
        (error: Error) => now.reverse().forEach(({ reject }) => reject(error)), // the last is taken back first
      );
    }
    sending = false;
  }

  return {
    save: (change) =>
      new Promise((resolve, reject) => {
        waiting.push({ change, resolve, reject });
        if (!sending) void sendAll();
      }),
  };
}
