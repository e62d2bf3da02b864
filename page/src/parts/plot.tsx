/** Curves (uPlot), with a sentence for who cannot see them. */

import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { onThemeChange, readTheme, type Theme } from "./theme.ts";

interface Props {
  data: uPlot.AlignedData;
  height: number; // pixels
  x: string | null; // what the axes are called; without a name this one has no numbers, either
  y: string | null;
  scales: uPlot.Scales;
  series: (theme: Theme) => uPlot.Series[];
  bands?: (theme: Theme) => uPlot.Band[]; // between two series each
  summary: string;
  anew?: unknown; // where it changes, so do scales
  onPlot?: (plot: uPlot) => void; // called with each that is made: also when light turns dark
}

export function Plot({ data, height, x, y, scales, series, bands, summary, anew, onPlot }: Props) {
  const holder = useRef<HTMLDivElement>(null);
  const plot = useRef<uPlot | null>(null);
  const latest = useRef(data);
  latest.current = data;

  useEffect(() => {
    const element = holder.current;
    if (element === null) return undefined;
    const build = () => {
      const theme = readTheme();
      const axis = {
        stroke: theme.quiet,
        grid: { stroke: theme.line, width: 1 },
        ticks: { show: false },
        labelSize: 20,
      };
      const options: uPlot.Options = {
        width: element.clientWidth,
        height,
        legend: { show: false },
        cursor: { drag: { x: false, y: false } },
        scales,
        axes: [
          x === null ? { ...axis, size: 6, values: () => [] } : { ...axis, label: x, size: 32 },
          {
            ...axis,
            ...(y !== null && { label: y }),
            size: 48,
            space: 22, // pixels between two numbers, at least
            values: (_, ticks) => ticks.map((tick) => (tick === null ? "" : `${tick}`)),
          },
        ],
        series: [{}, ...series(theme)],
        ...(bands && { bands: bands(theme) }),
      };
      plot.current?.destroy();
      plot.current = new uPlot(options, latest.current, element);
      onPlot?.(plot.current);
    };
    build();
    const watcher = new ResizeObserver(() => plot.current?.setSize({ width: element.clientWidth, height }));
    watcher.observe(element);
    const stop = onThemeChange(build);
    return () => {
      stop();
      watcher.disconnect();
      plot.current?.destroy();
      plot.current = null;
    };
    // eslint-disable-next-line react-hooks/exhaustive-deps -- what is drawn how is the same until `anew` changes
  }, [anew]);
  useEffect(() => plot.current?.setData(data), [data]);
  return <div ref={holder} class="curve" style={{ minHeight: height }} role="img" aria-label={summary} />;
}
