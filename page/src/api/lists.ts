/** Lists of what is stored: a page of one at a time, all of one, or a few by their identifiers. */

import { ask, askJson } from "./http.ts";
import type { Alias, Dataset, Fit, Kind, LiftStream, ModelSummary, WaitingJobs } from "./resources.ts";

export interface Page<T> {
  items: T[];
  next_cursor?: string | null;
}

/** What of a list is asked for, in the names of the API's query. */
export interface Query {
  search?: string;
  tag?: string;
  status?: string;
  dataset_id?: string;
  from_model?: string;
  id?: string[];
  limit?: number;
  cursor?: string;
}

export type Lister<T> = (query?: Query) => Promise<Page<T>>;

const MOST = 50; // of a list at a time, where somebody looks at it
const MOST_AT_ONCE = 200; // that the API gives
const MOST_OF_ALL = 2000; // that are fetched to be chosen from, or sorted

export const listFits: Lister<Fit> = (query) => listed("fits", query);
export const listDatasets: Lister<Dataset> = (query) => listed("datasets", query);
export const listModels: Lister<ModelSummary> = (query) => listed("models", query);
export const listAliases: Lister<Alias> = (query) => listed("aliases", query);
export const listStreams = () => askJson<Page<LiftStream>>("lift/streams");
export const listQueues = () => askJson<Page<WaitingJobs>>("queues");

/** Returns all that a query finds, the newest first, 2,000 at most. */
export async function listAll<T>(list: Lister<T>, query: Query = {}): Promise<T[]> {
  const found: T[] = [];
  let cursor: string | undefined;
  do {
    const page: Page<T> = await list({ ...query, limit: MOST_AT_ONCE, ...(cursor !== undefined && { cursor }) });
    found.push(...page.items);
    cursor = page.next_cursor ?? undefined;
  } while (cursor !== undefined && found.length < MOST_OF_ALL);
  return found;
}

/** Returns those of some identifiers that there are. */
export async function listThese<T>(list: Lister<T>, ids: Iterable<string>): Promise<T[]> {
  const wanted = [...new Set(ids)];
  const parts: Promise<Page<T>>[] = [];
  for (let at = 0; at < wanted.length; at += MOST_AT_ONCE)
    parts.push(list({ id: wanted.slice(at, at + MOST_AT_ONCE) }));
  return (await Promise.all(parts)).flatMap((page) => page.items);
}

interface Deleted {
  refused: { id: string; detail: string }[];
}

/** Deletes some, and returns what was not deleted and why. */
export async function removeThese(kind: Kind, ids: string[]): Promise<Deleted["refused"]> {
  const refused: Deleted["refused"] = [];
  for (let at = 0; at < ids.length; at += MOST_AT_ONCE) {
    const query = queryOf({ id: ids.slice(at, at + MOST_AT_ONCE) });
    const { found } = (await (await ask(`${kind}?${query}&dry_run=true`, { method: "DELETE" })).json()) as {
      found: number;
    };
    const answer = await ask(`${kind}?${query}&expected_count=${found}`, { method: "DELETE" });
    refused.push(...((await answer.json()) as Deleted).refused);
  }
  return refused;
}

function listed<T>(kind: string, query: Query = {}): Promise<Page<T>> {
  return askJson<Page<T>>(`${kind}?${queryOf({ limit: MOST, ...query })}`);
}

function queryOf(query: Query): string {
  const pairs = Object.entries(query).flatMap(([name, value]: [string, string | string[] | number]) =>
    (Array.isArray(value) ? value : [value]).filter((each) => each !== "").map((each) => [name, String(each)]),
  );
  return new URLSearchParams(pairs).toString();
}
