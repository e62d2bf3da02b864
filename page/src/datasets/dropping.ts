/** Files that were dropped or chosen, with the folders that they were in. */

/** A file, and its path from what was dropped: `cam1/000.json`. */
export interface Placed {
  path: string;
  file: File;
}

/** Returns all files of a drop, in the order of their paths. */
export async function filesOf(drop: DataTransfer): Promise<Placed[]> {
  const entries = [...drop.items].map((item) => item.webkitGetAsEntry()).filter((entry) => entry !== null);
  const files = (await Promise.all(entries.map(read))).flat();
  return sorted(files.length > 0 ? files : chosen(drop.files));
}

/** Returns the files of a list, which has paths if a folder was chosen. */
export function chosen(files: FileList | null): Placed[] {
  return sorted([...(files ?? [])].map((file) => ({ path: file.webkitRelativePath || file.name, file })));
}

/** Returns files in natural order, without those that a computer hides. */
function sorted(files: Placed[]): Placed[] {
  const byName = new Intl.Collator("en", { numeric: true });
  const hidden = ({ path }: Placed) => path.split("/").some((part) => part.startsWith(".") || part === "__MACOSX");
  return files.filter((file) => !hidden(file)).sort((a, b) => byName.compare(a.path, b.path));
}

/** Returns files with more of them. What was there already is not there twice; what is another file or
 * folder of the same name gets a number. */
export function joined(files: Placed[], more: Placed[]): Placed[] {
  const there = byTop(files);
  const added: Placed[] = [];
  for (const [top, inside] of byTop(more)) {
    const known = there.get(top);
    if (known === undefined) added.push(...inside);
    else if (!alike(known, inside)) added.push(...renamed(inside, top, free(top, there)));
  }
  return sorted([...files, ...added]);
}

/** What is listed as one: the files of a folder, or a file that is in none. */
export interface Group {
  name: string; // a folder's ends with a stroke
  files: Placed[];
}

export function groupsOf(files: Placed[]): Group[] {
  const groups = groupedBy(files, ({ path }) => {
    const end = path.lastIndexOf("/");
    return end < 0 ? path : path.slice(0, end + 1);
  });
  return [...groups].map(([name, inside]) => ({ name, files: inside }));
}

function byTop(files: Placed[]): Map<string, Placed[]> {
  return groupedBy(files, ({ path }) => path.split("/", 1)[0] ?? path);
}

function groupedBy(files: Placed[], key: (file: Placed) => string): Map<string, Placed[]> {
  const groups = new Map<string, Placed[]>();
  for (const file of files) {
    const group = groups.get(key(file));
    if (group === undefined) groups.set(key(file), [file]);
    else group.push(file);
  }
  return groups;
}

function alike(one: Placed[], other: Placed[]): boolean {
  const marks = (files: Placed[]) => files.map(({ path, file }) => `${path} ${file.size} ${file.lastModified}`).sort();
  return marks(one).join("\n") === marks(other).join("\n");
}

function renamed(files: Placed[], top: string, name: string): Placed[] {
  return files.map(({ path, file }) => ({ path: name + path.slice(top.length), file }));
}

/** Returns a name like this that nothing has: `walk (2).csv`. */
function free(top: string, taken: Map<string, unknown>): string {
  const [, stem = top, ending = ""] = /^([^.]+)(.*)$/.exec(top) ?? [];
  for (let number = 2; ; number++) {
    const name = `${stem} (${number})${ending}`;
    if (!taken.has(name)) return name;
  }
}

async function read(entry: FileSystemEntry): Promise<Placed[]> {
  if (entry.isFile) {
    const file = await new Promise<File>((resolve, reject) => (entry as FileSystemFileEntry).file(resolve, reject));
    return [{ path: entry.fullPath.replace(/^\//, ""), file }];
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  const files: Placed[] = [];
  for (;;) {
    const some = await new Promise<FileSystemEntry[]>((resolve, reject) => reader.readEntries(resolve, reject));
    if (some.length === 0) return files;
    files.push(...(await Promise.all(some.map(read))).flat());
  }
}
