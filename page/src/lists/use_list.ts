/** A list of what is stored: a page at a time or, to be sorted, all of it. */

import { useEffect, useRef, useState } from "preact/hooks";
import { listAll, type Lister } from "../api/lists.ts";
import { currentRoute, keepInAddress } from "../route.ts";

/** What is asked for; it is kept in the address, so that a link leads to it, and the way back. */
export interface Wanted {
  search: string;
  tag: string;
  status: string;
  /** The title of a column; with "-" before it, the largest first. Empty: the newest first. */
  sort: string;
}

export interface List<T> {
  items: T[] | null; // null while it is not there yet
  trouble: string | null;
  /** Shows older ones; null where there are none. */
  more: (() => void) | null;
  wanted: Wanted;
  want: (change: Partial<Wanted>) => void;
  /** Takes the newer state of one. */
  put: (item: T) => void;
  /** Forgets some that were deleted. */
  drop: (ids: Set<string>) => void;
}

export function useList<T extends { id: string }>(list: Lister<T>): List<T> {
  const [items, setItems] = useState<T[] | null>(null);
  const [next, setNext] = useState<string | null>(null);
  const [trouble, setTrouble] = useState<string | null>(null);
  const [wanted, setWanted] = useState(wantedInAddress);
  const asked = useRef(0);
  const { search, tag, status, sort } = wanted;
  const query = { search: search.trim(), tag, status };
  const whole = sort !== "";

  const load = async (cursor?: string) => {
    const number = ++asked.current;
    try {
      const page = whole ? { items: await listAll(list, query) } : await list(cursor ? { ...query, cursor } : query);
      if (number !== asked.current) return; // something else was asked for meanwhile
      setItems((before) => [...(cursor === undefined ? [] : (before ?? [])), ...page.items]);
      setNext(page.next_cursor ?? null);
      setTrouble(null);
    } catch (error) {
      if (number === asked.current) setTrouble((error as Error).message);
    }
  };
  useEffect(() => {
    void load();
    // eslint-disable-next-line react-hooks/exhaustive-deps -- what is wanted decides, not the function that asks
  }, [search.trim(), tag, status, whole]);

  const latest = useRef(wanted); // a search that was typed is asked for later, when more may be wanted
  const want = (change: Partial<Wanted>) => {
    latest.current = { ...latest.current, ...change };
    setWanted(latest.current);
    keepInAddress(Object.fromEntries(Object.entries(latest.current).filter(([, value]) => value !== "")));
  };
  const put = (newer: T) => setItems((all) => all?.map((each) => (each.id === newer.id ? newer : each)) ?? null);
  const drop = (ids: Set<string>) => setItems((all) => all?.filter(({ id }) => !ids.has(id)) ?? null);
  const more = next === null ? null : () => void load(next);
  return { items, trouble, more, wanted, want, put, drop };
}

function wantedInAddress(): Wanted {
  const { query } = currentRoute();
  const of = (name: string) => query.get(name) ?? "";
  return { search: of("search"), tag: of("tag"), status: of("status"), sort: of("sort") };
}
