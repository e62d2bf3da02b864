/** Some series of the same scale, each with a band of how far it may be off. */

import { useMemo } from "preact/hooks";
import type uPlot from "uplot";
import { number } from "../../parts/format.ts";
import type { Theme } from "../../parts/theme.ts";
import { Plot } from "../../parts/plot.tsx";
import { quantile } from "../../science/worst.ts";
import type { Curves } from "./curve_choice.ts";
import { useLinkedPlot } from "./linked_plot.ts";

const EDGE: uPlot.Series = { width: 0, points: { show: false } }; // of a band
const BAND = "40"; // opacity, as the end of a colour
const [HIGH, LOW, AXIS] = [150, 90, 46]; // pixels: of a pane, of one of several, of the numbers below it

export interface Line {
  name: string;
  colour: keyof Theme;
  values: Float64Array; // (N,), NaN where there is no answer
  deviations: Float64Array | null; // (N,), NaN where not known; null: never known
}

interface Props {
  curves: Curves;
  lines: Line[];
  x: Float64Array; // (N,) where frames are
  name: string | null; // of this axis, where it has numbers
  y: string | null; // what the other one is called
}

export function Pane({ curves, lines, x, name, y }: Props) {
  const { possible, label, unit, apart } = curves;
  const data = useMemo(
    (): uPlot.AlignedData => [
      x,
      ...lines.map(({ values }) => withGaps(values)),
      ...lines.flatMap((line) => edgesOf(line, possible)),
    ],
    [x, lines, possible],
  );
  const linked = useLinkedPlot(x);
  return (
    <Plot
      data={data}
      height={(apart ? LOW : HIGH) + (name === null ? 0 : AXIS)}
      x={name}
      y={y}
      scales={{ x: { time: false }, y: {} }}
      series={(theme) => [
        ...lines.map(({ colour }) => ({ stroke: theme[colour], width: 1.5, points: { show: false } })),
        ...lines.flatMap(() => [EDGE, EDGE]),
      ]}
      bands={(theme) =>
        lines.map(({ colour }, index) => {
          const upper = 1 + lines.length + 2 * index;
          return { series: [upper, upper + 1], fill: `${theme[colour]}${BAND}` };
        })
      }
      summary={`${label}, ${unit}: ${lines.map(rangeOf).join("; ")}`}
      anew={lines.map((line) => line.name).join("\n")}
      onPlot={linked}
    />
  );
}

/** Returns the upper and the lower edge of a band, within what is possible. */
function edgesOf({ values, deviations }: Line, [least, most]: Curves["possible"]) {
  return [1, -1].map((way) =>
    withGaps(values.map((value, frame) => Math.min(most, Math.max(least, value + way * (deviations?.[frame] ?? NaN))))),
  );
}

function withGaps(values: Float64Array): (number | null)[] {
  return Array.from(values, (value) => (Number.isNaN(value) ? null : value));
}

function rangeOf({ name, values, deviations }: Line): string {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    if (value < low) low = value; // false for NaN
    if (value > high) high = value;
  }
  const off = quantile(deviations ?? [], 0.5);
  return `${name} from ${number(low)} to ${number(high)}${off > 0 ? `, usually ± ${number(off, 2)}` : ""}`;
}
