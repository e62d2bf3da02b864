/** Files that were dropped, those of dropped folders too. */

/** Returns all files of a drop, by name. */
export async function filesOf(drop: DataTransfer): Promise<File[]> {
  const entries = [...drop.items].map((item) => item.webkitGetAsEntry()).filter((entry) => entry !== null);
  const files = (await Promise.all(entries.map(read))).flat();
  return sorted(files.length > 0 ? files : [...drop.files]);
}

export function sorted(files: File[]): File[] {
  const byName = new Intl.Collator("en", { numeric: true });
  return files.filter((file) => !file.name.startsWith(".")).sort((a, b) => byName.compare(a.name, b.name));
}

async function read(entry: FileSystemEntry): Promise<File[]> {
  if (entry.isFile) {
    return [await new Promise<File>((resolve, reject) => (entry as FileSystemFileEntry).file(resolve, reject))];
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  const files: File[] = [];
  for (;;) {
    const some = await new Promise<FileSystemEntry[]>((resolve, reject) => reader.readEntries(resolve, reject));
    if (some.length === 0) return files;
    files.push(...(await Promise.all(some.map(read))).flat());
  }
}
