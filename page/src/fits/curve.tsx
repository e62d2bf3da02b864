/** A curve of errors over steps. */

import { number } from "../parts/format.ts";
import { Plot } from "../parts/plot.tsx";

interface Row {
  step: number;
  error: number; // pixels
}

export function Curve({ rows, steps }: { rows: Row[]; steps: number }) {
  const [first, last] = [rows.at(0), rows.at(-1)];
  return (
    <Plot
      data={[rows.map((row) => row.step), rows.map((row) => row.error)]}
      height={220}
      x="step"
      y="reprojection error, px"
      scales={{ x: { time: false, range: [0, steps] }, y: { distr: 3 } }}
      series={({ accent }) => [{ stroke: accent, width: 2, points: { show: false } }]}
      summary={
        first === undefined || last === undefined
          ? "No errors yet."
          : `Reprojection error by step: from ${number(first.error)} to ${number(last.error)} pixels.`
      }
      anew={steps}
    />
  );
}
