/** Follows a fit by server-sent events. `EventSource` cannot send a key, so a stream is read. */

import { addressOf, keyHeader, refusalOf } from "./http.ts";
import type { Fit } from "./resources.ts";

const AGAIN_MS = 2000; // after a connection broke

/** Calls `onFit` with every state of a fit until it has ended; goes on after a break. Returns what
 * stops it. */
export function followFit(id: string, onFit: (fit: Fit) => void, onTrouble: (error: Error | null) => void): () => void {
  const stop = new AbortController();
  void follow(id, onFit, onTrouble, stop.signal);
  return () => stop.abort();
}

async function follow(
  id: string,
  onFit: (fit: Fit) => void,
  onTrouble: (error: Error | null) => void,
  signal: AbortSignal,
): Promise<void> {
  let last: string | null = null;
  while (!signal.aborted) {
    try {
      const headers: Record<string, string> = { ...keyHeader(), Accept: "text/event-stream" };
      if (last !== null) headers["Last-Event-ID"] = last;
      const url = addressOf(`fits/${encodeURIComponent(id)}/events`);
      const response = await fetch(url, { headers, signal });
      if (!response.ok || response.body === null) {
        throw refusalOf(response.status, await response.text());
      }
      onTrouble(null);
      for await (const event of eventsOf(response.body)) {
        last = event.id;
        onFit(JSON.parse(event.data) as Fit);
        if (event.name === "end") return;
      }
    } catch (error) {
      if (signal.aborted) return;
      onTrouble(error as Error);
    }
    await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
  }
}

interface SentEvent {
  id: string;
  name: string;
  data: string;
}

/** Yields the events of a stream of text. */
async function* eventsOf(body: ReadableStream<Uint8Array>): AsyncGenerator<SentEvent> {
  const reader = body.getReader();
  const decoder = new TextDecoder();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    text = (text + decoder.decode(value, { stream: true })).replaceAll("\r\n", "\n");
    for (let end = text.indexOf("\n\n"); end >= 0; end = text.indexOf("\n\n")) {
      const event = parsed(text.slice(0, end));
      text = text.slice(end + 2);
      if (event.data !== "") yield event;
    }
  }
}

function parsed(block: string): SentEvent {
  const event = { id: "", name: "", data: "" };
  for (const line of block.split("\n")) {
    const [field, ...words] = line.split(":");
    const value = words.join(":").trimStart();
    if (field === "id") event.id = value;
    if (field === "event") event.name = value;
    if (field === "data") event.data += value;
  }
  return event;
}
