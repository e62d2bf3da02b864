/** Covariances of a result's points, which are fetched when something shown needs them. */

import { useCallback, useEffect, useRef, useState } from "preact/hooks";
import { loadCovariances } from "../data/covariances.ts";
import type { Result } from "../data/loading.ts";
import { knowsDeviations } from "../data/take.ts";
import type { Covariances } from "../science/covariances.ts";

export interface KnownCovariances {
  known: Covariances | null;
  coming: boolean;
  trouble: string | null; // why they did not come
  ask(): void;
}

export const NO_COVARIANCES: KnownCovariances = { known: null, coming: false, trouble: null, ask: () => {} };

export function useCovariances(fit: string, { take, query }: Pick<Result, "take" | "query">): KnownCovariances {
  const [state, setState] = useState<Omit<KnownCovariances, "ask">>(NO_COVARIANCES);
  const asked = useRef(false);
  const current = useRef(true);
  useEffect(() => {
    current.current = true;
    return () => {
      current.current = false;
    };
  }, []);
  const ask = useCallback(() => {
    if (asked.current || !knowsDeviations(take)) return;
    asked.current = true;
    setState({ known: null, coming: true, trouble: null });
    loadCovariances(fit, take, query).then(
      (known) => current.current && setState({ known, coming: false, trouble: null }),
      ({ message }: Error) => current.current && setState({ known: null, coming: false, trouble: message }),
    );
  }, [fit, take, query]);
  return { ...state, ask };
}
