/** Numbers and moments as people read them. */

const PLAIN = new Intl.NumberFormat("en", { maximumSignificantDigits: 6 });
const MOST_DECIMALS = 6;
const PLUS_MINUS = "\u00a0±\u00a0"; // which no line breaks at

export function number(value: number | null | undefined, digits = 3): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const text = Math.abs(value) >= 1000 ? Math.round(value).toString() : value.toPrecision(digits);
  return PLAIN.format(Number(text));
}

/** Returns a value with its standard deviation, both to the second digit of that (GUM, 7.2.6): 1.234 ± 0.012. The value
 * alone where the deviation is not known.
 *
 * @param unit that follows each number */
export function plusMinus(value = NaN, deviation = NaN, unit = ""): string {
  if (!Number.isFinite(value) || !Number.isFinite(deviation) || deviation <= 0) return `${number(value)}${unit}`;
  const decimals = Math.min(MOST_DECIMALS, Math.max(0, 1 - Math.floor(Math.log10(deviation))));
  return `${value.toFixed(decimals)}${unit}${PLUS_MINUS}${deviation.toFixed(decimals)}${unit}`;
}

export function pixels(value: number | null | undefined): string {
  return value === null || value === undefined || Number.isNaN(value) ? "–" : `${number(value)} px`;
}

export function percent(share: number): string {
  return `${(100 * share).toFixed(share > 0 && share < 0.1 ? 1 : 0)} %`;
}

export function count(many: number, word: string): string {
  return `${many.toLocaleString("en")} ${word}${many === 1 ? "" : "s"}`;
}

export function moment(iso: string): string {
  return new Date(iso).toLocaleString(undefined, { dateStyle: "medium", timeStyle: "short" });
}

export function duration(seconds: number): string {
  if (seconds < 90) return `${Math.round(seconds)} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 90 ? `${minutes} min` : `${(minutes / 60).toFixed(1)} h`;
}

export function bytes(size: number): string {
  const units = ["B", "KB", "MB", "GB"];
  let at = 0;
  for (; size >= 1000 && at < units.length - 1; at++) size /= 1000;
  return `${size.toFixed(at > 0 && size < 10 ? 1 : 0)} ${units[at]}`;
}

/** Returns the words of a name that code uses: `frame_unlike_fit` is "Frame unlike fit". */
export function words(name: string): string {
  const text = name.replaceAll("_", " ");
  return text.slice(0, 1).toUpperCase() + text.slice(1);
}
