/** The streams that programs have open just now, each a click away from being watched. */

import { useEffect, useState } from "preact/hooks";
import { listStreams } from "../api/lists.ts";
import type { LiftStream, ModelSummary } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";
import { count, moment, number } from "../parts/format.ts";
import { linkTo } from "../route.ts";

const PERIOD_MS = 2000; // between two looks

export function OpenStreams({ models = [] }: { models?: ModelSummary[] }) {
  const [streams, setStreams] = useState<LiftStream[]>([]);
  const [trouble, setTrouble] = useState<string | null>(null);
  useEffect(() => {
    let current = true;
    let timer = 0;
    const look = async () => {
      try {
        const found = await listStreams();
        if (current) setStreams(found.items);
        if (current) setTrouble(null);
      } catch (error) {
        if (current) setTrouble((error as Error).message);
      }
      if (current) timer = window.setTimeout(() => void look(), PERIOD_MS);
    };
    void look();
    return () => {
      current = false;
      clearTimeout(timer);
    };
  }, []);
  return (
    <section aria-label="Open streams">
      <h2>Open streams</h2>
      <Alert>{trouble}</Alert>
      {streams.length === 0 && trouble === null && (
        <p class="quiet">No program streams just now. One that does is listed here within a second or two.</p>
      )}
      <ul class="list">
        {streams.map((stream) => (
          <li key={stream.id}>
            <a class="panel row" href={linkTo("live", stream.id)}>
              <strong>{models.find(({ id }) => id === stream.model)?.name ?? stream.model}</strong>
              <span class="quiet">
                opened {moment(stream.since)} by {stream.key_id}
              </span>
              <span class="facts">
                <span>{number(stream.frames_per_second)} frames/s</span>
                <span>{number(stream.latency_ms)} ms</span>
                {stream.dropped > 0 && <span class="warned">{count(stream.dropped, "frame")} dropped</span>}
              </span>
            </a>
          </li>
        ))}
      </ul>
    </section>
  );
}
