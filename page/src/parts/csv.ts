/** Tables as text that spreadsheets read (RFC 4180). */

/** Returns a table of named columns; NaN is an empty cell. */
export function csvOf(columns: readonly { name: string; values: ArrayLike<number> }[]): string {
  const rows = [columns.map(({ name }) => cellOf(name)).join(",")];
  const count = columns[0]?.values.length ?? 0;
  for (let row = 0; row < count; row++) rows.push(columns.map(({ values }) => numberOf(values[row])).join(","));
  return `${rows.join("\r\n")}\r\n`;
}

/** Returns a text as a cell. What a spreadsheet would run as a formula (OWASP, "CSV injection") stays text. */
export function cellOf(text: string): string {
  const harmless = /^[=+\-@\t\r]/.test(text) ? `'${text}` : text;
  return /[",\r\n]/.test(harmless) ? `"${harmless.replaceAll('"', '""')}"` : harmless;
}

function numberOf(value: number | undefined): string {
  return value === undefined || Number.isNaN(value) ? "" : `${Number(value.toPrecision(7))}`;
}
