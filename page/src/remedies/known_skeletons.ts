/** The ready skeletons that the service knows. */

import { useEffect, useState } from "preact/hooks";
import { listSkeletons, type KnownSkeleton } from "../api/resources.ts";

export function useKnownSkeletons(): KnownSkeleton[] {
  const [known, setKnown] = useState<KnownSkeleton[]>([]);
  useEffect(() => {
    listSkeletons().then(
      ({ items }) => setKnown(items),
      () => {}, // one can go on without them
    );
  }, []);
  return known;
}

/** Returns skeletons as choices, by name. */
export function choicesOf(known: readonly KnownSkeleton[]): [string, string][] {
  return known.map(({ name, title, keypoint_names: names }) => [name, `${title} (${names.length})`]);
}
