/** The settings of fits in a few words, and what differs between fits. */

import type { Fit } from "../api/resources.ts";

type Config = NonNullable<Fit["config"]>;

const MOST_SHOWN = 3;

/** Returns for each of several fits the settings in which it differs from most of them, in a few words. */
export function unusualSettings(fits: Fit[]): Map<string, string> {
  const configs = fits.flatMap(({ config }) => (config ? [config] : []));
  const names = [...new Set(configs.flatMap((config) => Object.keys(config)))] as (keyof Config)[];
  const usual = new Map(names.map((name) => [name, mostOften(configs.map((config) => JSON.stringify(config[name])))]));
  return new Map(
    fits.map(({ id, config }) => {
      const odd = names.filter((name) => config && JSON.stringify(config[name]) !== usual.get(name));
      const shown = odd.slice(0, MOST_SHOWN).map((name) => `${name.replaceAll("_", " ")} ${shortly(config?.[name])}`);
      return [id, [...shown, ...(odd.length > MOST_SHOWN ? [`${odd.length - MOST_SHOWN} more`] : [])].join(", ")];
    }),
  );
}

function mostOften(texts: (string | undefined)[]): string | undefined {
  const counts = new Map<string | undefined, number>();
  for (const text of texts) counts.set(text, (counts.get(text) ?? 0) + 1);
  return [...counts].sort(([, a], [, b]) => b - a)[0]?.[0];
}

/** Returns how long a fit took in seconds, NaN where it has not ended. */
export function secondsOf({ started_at: start, finished_at: end }: Fit): number {
  return start && end ? (Date.parse(end) - Date.parse(start)) / 1000 : NaN;
}

/** Returns the settings of several fits, those first in which they differ. */
export function compared(configs: Fit["config"][]): { name: string; values: string[]; differs: boolean }[] {
  const names = [...new Set(configs.flatMap((config) => Object.keys(config ?? {})))] as (keyof Config)[];
  const rows = names.map((name) => {
    const values = configs.map((config) => config?.[name]);
    return {
      name: name.replaceAll("_", " "),
      values: values.map(shortly),
      differs: !values.every((v) => same(v, values[0])),
    };
  });
  return [...rows.filter((row) => row.differs), ...rows.filter((row) => !row.differs)];
}

function same(one: unknown, other: unknown): boolean {
  return JSON.stringify(one ?? null) === JSON.stringify(other ?? null);
}

function shortly(value: unknown): string {
  if (value === null || value === undefined) return "–";
  if (typeof value === "boolean") return value ? "yes" : "no";
  // eslint-disable-next-line @typescript-eslint/no-base-to-string -- objects are written below
  if (typeof value !== "object") return String(value);
  const text = JSON.stringify(value);
  return text.length > 40 ? "given" : text;
}
