/** How long answers took in the last two minutes. */

import { number } from "../parts/format.ts";
import { Plot } from "../parts/plot.tsx";
import type { Second } from "./feed.ts";

export function LatencyCurve({ seconds }: { seconds: Second[] }) {
  const now = seconds.at(-1)?.at ?? 0;
  const known = seconds.flatMap(({ p95 }) => p95 ?? []);
  return (
    <Plot
      data={[seconds.map(({ at }) => at - now), seconds.map(({ median }) => median), seconds.map(({ p95 }) => p95)]}
      height={180}
      x="seconds"
      y="ms until an answer"
      scales={{ x: { time: false, range: [-120, 0] }, y: { range: (_, _least, most) => [0, 1.1 * (most || 1)] } }}
      series={({ accent, quiet }) => [
        { stroke: accent, width: 2, points: { show: false } },
        { stroke: quiet, width: 1, points: { show: false } },
      ]}
      summary={
        known.length === 0
          ? "No answers yet."
          : `Time until an answer, median and 95th percentile of each second: at most ${number(Math.max(...known))} ms.`
      }
    />
  );
}
