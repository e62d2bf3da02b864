/** Which files were sent in part, and to which dataset, so that they can be finished another day. */

const PLACE = "fewview-unfinished";
const MOST = 20;

type Kept = Record<string, string>; // datasets by files

export function remember(file: File, dataset: string): void {
  const others = Object.entries(kept()).filter(([known]) => known !== markOf(file));
  keep(Object.fromEntries([...others.slice(1 - MOST), [markOf(file), dataset]]));
}

export function recall(file: File): string | null {
  return kept()[markOf(file)] ?? null;
}

export function forget(file: File): void {
  const mark = markOf(file);
  keep(Object.fromEntries(Object.entries(kept()).filter(([other]) => other !== mark)));
}

/** Two files of the same name, size and moment are taken for one. */
function markOf({ name, size, lastModified }: File): string {
  return `${name} ${size} ${lastModified}`;
}

function kept(): Kept {
  try {
    return JSON.parse(localStorage.getItem(PLACE) ?? "{}") as Kept;
  } catch {
    return {};
  }
}

function keep(files: Kept): void {
  localStorage.setItem(PLACE, JSON.stringify(files));
}
