/** A curve of errors over steps (uPlot), with a sentence for who cannot see it. */

import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { number } from "../parts/format.ts";
import { onThemeChange, readTheme } from "../parts/theme.ts";

interface Row {
  step: number;
  error: number; // pixels
}

const HEIGHT = 220;

export function Curve({ rows, steps }: { rows: Row[]; steps: number }) {
  const holder = useRef<HTMLDivElement>(null);
  const plot = useRef<uPlot | null>(null);
  const data: uPlot.AlignedData = [rows.map((row) => row.step), rows.map((row) => row.error)];
  const latest = useRef(data);
  latest.current = data;

  useEffect(() => {
    const element = holder.current;
    if (element === null) return undefined;
    const build = () => {
      plot.current?.destroy();
      plot.current = new uPlot(optionsFor(element.clientWidth, steps), latest.current, element);
    };
    build();
    const watcher = new ResizeObserver(() => plot.current?.setSize({ width: element.clientWidth, height: HEIGHT }));
    watcher.observe(element);
    const stop = onThemeChange(build);
    return () => {
      stop();
      watcher.disconnect();
      plot.current?.destroy();
      plot.current = null;
    };
  }, [steps]);
  useEffect(() => plot.current?.setData(data), [rows.length]);

  const last = rows.at(-1);
  const summary =
    last === undefined
      ? "No errors yet."
      : `Reprojection error by step: from ${number(rows[0].error)} to ${number(last.error)} pixels.`;
  return <div ref={holder} class="curve" role="img" aria-label={summary} />;
}

function optionsFor(width: number, steps: number): uPlot.Options {
  const theme = readTheme();
  const axis = { stroke: theme.quiet, grid: { stroke: theme.line, width: 1 }, ticks: { show: false } };
  return {
    width,
    height: HEIGHT,
    legend: { show: false },
    cursor: { drag: { x: false, y: false } },
    scales: { x: { time: false, range: [0, steps] }, y: { distr: 3 } },
    axes: [
      { ...axis, label: "step", labelSize: 20, size: 32 },
      { ...axis, label: "reprojection error, px", labelSize: 20, size: 48, values: (_, ticks) => ticks.map((tick) => (tick ? `${tick}` : "")) },
    ],
    series: [{}, { stroke: theme.accent, width: 2, points: { show: false } }],
  };
}
