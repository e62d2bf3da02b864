/** The colours that are drawn on canvases: those of the style sheet, light or dark. */

export interface Theme {
  ground: string;
  panel: string;
  line: string;
  text: string;
  quiet: string;
  accent: string;
  left: string;
  right: string;
  middle: string;
  outlier: string;
  projected: string;
  bad: string;
}

const NAMES: (keyof Theme)[] = [
  "ground",
  "panel",
  "line",
  "text",
  "quiet",
  "accent",
  "left",
  "right",
  "middle",
  "outlier",
  "projected",
  "bad",
];

export function readTheme(): Theme {
  const style = getComputedStyle(document.documentElement);
  const read = (name: string) => style.getPropertyValue(`--${name}`).trim();
  return Object.fromEntries(NAMES.map((name) => [name, read(name)])) as unknown as Theme;
}

/** Returns the colour of a side: -1 left, 0 neither, 1 right. */
export function colourOf(theme: Theme, side: number): string {
  return side < 0 ? theme.left : side > 0 ? theme.right : theme.middle;
}

/** Calls a function when the system changes between light and dark; returns what stops that. */
export function onThemeChange(listener: () => void): () => void {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  dark.addEventListener("change", listener);
  return () => dark.removeEventListener("change", listener);
}
