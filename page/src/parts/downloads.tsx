/** Buttons that save what the service exports. */

import type { ComponentChildren } from "preact";
import { useState } from "preact/hooks";
import { download } from "../api/download.ts";
import { Alert } from "./alert.tsx";
import { Icon } from "./icons.tsx";

export type Entry = [label: string, path: string, file: string];

interface Props {
  groups: [title: string, entries: Entry[], beside?: ComponentChildren][];
  /** Returns why an entry cannot be had just now. */
  hindered?: (label: string) => string | undefined;
}

export function Downloads({ groups, hindered = () => undefined }: Props) {
  const [trouble, setTrouble] = useState<string | null>(null);
  const save = (path: string, file: string) => {
    setTrouble(null);
    download(path, file).catch((error: Error) => setTrouble(error.message));
  };
  return (
    <>
      {groups
        .filter(([, entries]) => entries.length > 0)
        .map(([title, entries, beside]) => (
          <div class="exports" key={title}>
            <span>
              {title}
              {beside}
            </span>
            <span class="buttons">
              {entries.map(([label, path, file]) => (
                <button
                  key={label}
                  disabled={hindered(label) !== undefined}
                  title={hindered(label)}
                  onClick={() => save(path, file)}
                >
                  <Icon name="save" /> {label}
                </button>
              ))}
            </span>
          </div>
        ))}
      <Alert>{trouble}</Alert>
    </>
  );
}
