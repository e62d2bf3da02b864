/** Sends corrections to the service in the order in which they were made, one request at a time. */

import { Refusal } from "../../api/http.ts";
import { correctKeypoints, readCorrections, type DatasetCorrections } from "../../api/resources.ts";
import { placeOf, type Place, type Position } from "../../data/corrections.ts";

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

/** @param known the checksum of the corrections that the page has
 * @param tag of the dataset when it was read */
export function createSaver(dataset: string, known: string | null, tag: string | null): Saver {
  let before: Promise<unknown> = Promise.resolve();

  async function send({ place, position }: Change): Promise<string | null> {
    const change = position === undefined ? { undo: [placeOf(place)] } : { correct: [{ ...placeOf(place), position }] };
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

  return {
    save(change) {
      const saved = before.then(
        () => send(change),
        () => send(change),
      );
      before = saved.catch(() => {});
      return saved;
    },
  };
}
