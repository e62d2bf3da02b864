/** Requests to the service that this page came from, under whatever prefix a proxy gives it. */

import { askForKey, currentKey } from "./key.ts";

interface Problem {
  title?: string;
  detail?: string;
  code?: string;
  errors?: { pointer: string; detail: string }[];
}

/** An answer that says why not, in the service's own words. */
export class Refusal extends Error {
  readonly status: number;
  readonly code: string;
  readonly fields: string[]; // of the request that are at fault

  constructor(status: number, problem: Problem) {
    const reasons = (problem.errors ?? []).map((each) => `${each.pointer}: ${each.detail}`);
    super(reasons.join("; ") || problem.detail || problem.title || `The service answered ${status}.`);
    this.status = status;
    this.code = problem.code ?? "";
    this.fields = (problem.errors ?? []).flatMap(({ pointer }) => pointer.split("/")[1] ?? []);
  }
}

export function addressOf(path: string): string {
  return new URL(path, document.baseURI).href;
}

export function keyHeader(): Record<string, string> {
  const key = currentKey();
  return key === null ? {} : { Authorization: `Bearer ${key}` };
}

/** Returns the answer to a request; throws `Refusal` for any that is not a success. */
export async function ask(path: string, init: RequestInit = {}): Promise<Response> {
  let response: Response;
  try {
    response = await fetch(addressOf(path), {
      ...init,
      headers: { ...keyHeader(), ...(init.headers as Record<string, string> | undefined) },
    });
  } catch (error) {
    if (error instanceof DOMException && error.name === "AbortError") throw error;
    throw new Refusal(0, { detail: "The service does not answer. Is it running?" });
  }
  if (response.ok) return response;
  throw refusalOf(response.status, await response.text());
}

/** Returns the error of an answer's status and text; a missing key is asked for. */
export function refusalOf(status: number, text: string): Refusal {
  if (status === 401) askForKey();
  try {
    return new Refusal(status, JSON.parse(text) as Problem);
  } catch {
    return new Refusal(status, {});
  }
}

export async function askJson<T>(path: string, init?: RequestInit): Promise<T> {
  return (await (await ask(path, init)).json()) as T;
}

/** Returns an answer and its entity tag, with which a change is refused if another came before it. */
export async function askTagged<T>(path: string, init?: RequestInit): Promise<{ found: T; tag: string | null }> {
  const answer = await ask(path, init);
  return { found: (await answer.json()) as T, tag: answer.headers.get("ETag") };
}

export async function askBytes(path: string): Promise<ArrayBuffer> {
  return (await ask(path)).arrayBuffer();
}

/** Returns bytes of a file from a start up to an end, and the file's size; a negative start counts from
 * the end. */
export async function askRange(
  path: string,
  start: number,
  end?: number,
): Promise<{ bytes: ArrayBuffer; size: number }> {
  const range = start < 0 ? `bytes=${start}` : `bytes=${start}-${(end ?? start + 1) - 1}`;
  const answer = await ask(path, { headers: { Range: range } });
  const bytes = await answer.arrayBuffer();
  const size = Number(answer.headers.get("Content-Range")?.split("/")[1] ?? bytes.byteLength);
  return { bytes, size };
}

/** @param tag of what the body changes, if that must not have changed meanwhile */
export async function sendJson<T>(path: string, body: unknown, method = "POST", tag: string | null = null): Promise<T> {
  return (await sendTagged<T>(path, body, method, tag)).found;
}

/** Does the same, and returns the entity tag of what is changed, too. */
export function sendTagged<T>(path: string, body: unknown, method: string, tag: string | null) {
  return askTagged<T>(path, {
    method,
    body: JSON.stringify(body),
    headers: { "Content-Type": "application/json", ...(tag !== null && { "If-Match": tag }) },
  });
}
