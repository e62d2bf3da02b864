/** What becomes of others when something stored is deleted. */

import { useEffect, useState } from "preact/hooks";
import { listAll, listFits, listModels, listThese } from "../api/lists.ts";
import type { Kind } from "../api/resources.ts";
import { count } from "../parts/format.ts";

const MOST_ASKED = 20; // datasets whose fits are counted

/** Returns a sentence on what deleting some means; a general one until more is known. */
export function useConsequences(kind: Kind, ids: string[]): string {
  const [known, setKnown] = useState<string | null>(null);
  useEffect(() => {
    let current = true;
    setKnown(null);
    consequencesOf(kind, ids).then(
      (words) => current && setKnown(words),
      () => {}, // the general sentence does
    );
    return () => {
      current = false;
    };
    // eslint-disable-next-line react-hooks/exhaustive-deps -- the identifiers, joined, are what it depends on
  }, [kind, ids.join()]);
  return known ?? GENERAL[kind];
}

const GENERAL: Record<Kind, string> = {
  datasets: "Fits and models of it stay, but their results can no longer be played, for want of what the cameras saw.",
  models: "Results of its fit can no longer be played, for want of its cameras; their structures can still be saved.",
  fits: "Datasets and models stay.",
};

async function consequencesOf(kind: Kind, ids: string[]): Promise<string> {
  if (kind === "fits") return GENERAL.fits;
  if (kind === "models") {
    const fits = (await listThese(listModels, ids)).filter((model) => model.fit_id);
    if (fits.length === 0) return "No fit of this service needs it.";
    return `The results of ${count(fits.length, "fit")} can no longer be played, for want of the cameras; their structures can still be saved.`;
  }
  if (ids.length > MOST_ASKED) return GENERAL.datasets;
  const found = await Promise.all(ids.map((id) => listAll(listFits, { dataset_id: id, status: "succeeded" })));
  const fits = found.flat().length;
  if (fits === 0) return "No result is of it.";
  return `The results of ${count(fits, "fit")} can no longer be played, for want of what the cameras saw; structures and models stay.`;
}
