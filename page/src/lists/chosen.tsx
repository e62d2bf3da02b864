/** What can be done with those of a list that were chosen: tag, compare, delete. */

import type { ComponentChildren } from "preact";
import { useState } from "preact/hooks";
import { removeThese } from "../api/lists.ts";
import { relabel, type Kind } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";
import { count } from "../parts/format.ts";
import { Icon } from "../parts/icons.tsx";
import { useConsequences } from "./consequences.ts";
import type { Listed } from "./table.tsx";

interface Props<T> {
  kind: Kind;
  items: T[]; // that were chosen
  onTagged: (item: T) => void;
  onDeleted: (ids: Set<string>) => void;
  onNone: () => void;
  beside?: ComponentChildren;
}

export function Chosen<T extends Listed>({ kind, items, onTagged, onDeleted, onNone, beside }: Props<T>) {
  const [asking, setAsking] = useState(false);
  const [busy, setBusy] = useState(false);
  const [trouble, setTrouble] = useState<string | null>(null);
  const noun = kind.slice(0, -1);
  const act = async (work: () => Promise<void>) => {
    setBusy(true);
    setTrouble(null);
    await work().catch((error: Error) => setTrouble(error.message));
    setBusy(false);
  };
  const tag = (name: string) =>
    act(async () => {
      for (const item of items.filter(({ tags }) => !tags.includes(name))) {
        const { tags } = await relabel(kind, item.id, { tags: [...item.tags, name] });
        onTagged({ ...item, tags });
      }
    });
  const remove = () =>
    act(async () => {
      const refused = await removeThese(
        kind,
        items.map(({ id }) => id),
      );
      const kept = new Set(refused.map(({ id }) => id));
      setAsking(false);
      onDeleted(new Set(items.map(({ id }) => id).filter((id) => !kept.has(id))));
      if (refused.length > 0) setTrouble(refused.map(({ detail }) => detail).join(" "));
    });
  return (
    <section class="panel chosen" aria-label="Those chosen">
      <strong>{count(items.length, noun)} chosen</strong>
      {asking ? (
        <Confirm kind={kind} items={items} busy={busy} onYes={() => void remove()} onNo={() => setAsking(false)} />
      ) : (
        <>
          {beside}
          <TagForm busy={busy} onTag={(name) => void tag(name)} />
          <button disabled={busy} onClick={() => setAsking(true)}>
            <Icon name="bin" /> Delete
          </button>
          <button onClick={onNone}>Choose none</button>
        </>
      )}
      <Alert>{trouble}</Alert>
    </section>
  );
}

interface ConfirmProps {
  kind: Kind;
  items: Listed[];
  busy: boolean;
  onYes: () => void;
  onNo: () => void;
}

function Confirm({ kind, items, busy, onYes, onNo }: ConfirmProps) {
  const consequences = useConsequences(
    kind,
    items.map(({ id }) => id),
  );
  const what = items.length === 1 ? `this ${kind.slice(0, -1)}` : `these ${count(items.length, kind.slice(0, -1))}`;
  return (
    <>
      <span role="alert">
        Delete {what} for good? {consequences}
      </span>
      <span class="buttons">
        <button class="danger" disabled={busy} onClick={onYes}>
          Yes, delete {items.length === 1 ? "it" : "them"}
        </button>
        <button onClick={onNo} autofocus>
          Keep {items.length === 1 ? "it" : "them"}
        </button>
      </span>
    </>
  );
}

function TagForm({ busy, onTag }: { busy: boolean; onTag: (name: string) => void }) {
  const [name, setName] = useState("");
  return (
    <form
      class="tag-form"
      onSubmit={(event) => {
        event.preventDefault();
        onTag(name.trim());
        setName("");
      }}
    >
      <input
        aria-label="Tag for those chosen"
        placeholder="a tag"
        maxLength={64}
        value={name}
        onInput={(event) => setName(event.currentTarget.value)}
      />
      <button disabled={busy || name.trim() === ""}>Tag</button>
    </form>
  );
}
