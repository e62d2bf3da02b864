/** A list of what is stored, a page at a time. */

import { useEffect, useState } from "preact/hooks";

interface Page<T> {
  items: T[];
  next_cursor?: string | null;
}

export interface List<T> {
  items: T[] | null; // null while it is not there yet
  trouble: string | null;
  /** Shows older ones; null where there are none. */
  more: (() => void) | null;
  /** Takes the newer state of one. */
  put: (item: T) => void;
}

export function useList<T extends { id: string }>(ask: (cursor?: string) => Promise<Page<T>>): List<T> {
  const [items, setItems] = useState<T[] | null>(null);
  const [next, setNext] = useState<string | null>(null);
  const [trouble, setTrouble] = useState<string | null>(null);
  const load = (cursor?: string) =>
    ask(cursor).then(
      (page) => {
        setItems((before) => [...(cursor === undefined ? [] : (before ?? [])), ...page.items]);
        setNext(page.next_cursor ?? null);
      },
      (error: Error) => setTrouble(error.message),
    );
  const put = (newer: T) => setItems((all) => all?.map((each) => (each.id === newer.id ? newer : each)) ?? null);
  useEffect(() => void load(), []);
  return { items, trouble, more: next === null ? null : () => void load(next), put };
}
