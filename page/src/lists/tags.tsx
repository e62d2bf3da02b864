/** The tags of something stored: shown, taken off, put on. */

import { useState } from "preact/hooks";
import { relabel, type Kind } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";
import { Icon } from "../parts/icons.tsx";
import { linkTo } from "../route.ts";

interface Props {
  kind: Kind;
  id: string;
  tags: string[];
}

export function Tags({ kind, id, tags: first }: Props) {
  const [tags, setTags] = useState(first);
  const [typed, setTyped] = useState<string | null>(null);
  const [trouble, setTrouble] = useState<string | null>(null);
  const change = async (next: string[]) => {
    try {
      setTags((await relabel(kind, id, { tags: next })).tags);
      setTyped(null);
      setTrouble(null);
    } catch (error) {
      setTrouble((error as Error).message);
    }
  };
  return (
    <div class="tags where" aria-label="Tags" role="group">
      {tags.map((tag) => (
        <span class="chip" key={tag}>
          <a href={`${linkTo(kind)}?${new URLSearchParams({ tag })}`}>{tag}</a>
          <button
            class="plain"
            aria-label={`Take the tag ${tag} off`}
            onClick={() => void change(tags.filter((each) => each !== tag))}
          >
            <Icon name="close" />
          </button>
        </span>
      ))}
      {typed === null ? (
        <button class="chip" onClick={() => setTyped("")}>
          <Icon name="plus" /> tag
        </button>
      ) : (
        <form
          class="tag-form"
          onSubmit={(event) => {
            event.preventDefault();
            if (typed.trim() !== "") void change([...tags, typed.trim()]);
          }}
        >
          <input
            aria-label="New tag"
            value={typed}
            maxLength={64}
            autofocus
            onInput={(event) => setTyped(event.currentTarget.value)}
            onKeyDown={(event) => event.key === "Escape" && setTyped(null)}
          />
          <button disabled={typed.trim() === ""}>Add</button>
        </form>
      )}
      <Alert>{trouble}</Alert>
    </div>
  );
}
