/** The name of something stored, which can be changed, and the button that deletes it. */

import { useState } from "preact/hooks";
import { remove, rename, type Kind } from "../api/resources.ts";
import { useConsequences } from "../lists/consequences.ts";
import { Alert } from "./alert.tsx";
import { Icon } from "./icons.tsx";

interface Named {
  kind: Kind;
  id: string;
  name: string;
  onName: (name: string) => void;
}

/** A heading with a button that turns it into a field. */
export function NamedHeading({ kind, id, name, onName }: Named) {
  const [typed, setTyped] = useState<string | null>(null);
  const [trouble, setTrouble] = useState<string | null>(null);
  if (typed === null) {
    return (
      <>
        <h1>{name}</h1>
        <button class="icons plain-icon" aria-label="Rename" title="Rename" onClick={() => setTyped(name)}>
          <Icon name="pen" />
        </button>
      </>
    );
  }
  const save = async (event: Event) => {
    event.preventDefault();
    try {
      onName((await rename(kind, id, typed.trim())).name);
      setTyped(null);
      setTrouble(null);
    } catch (error) {
      setTrouble((error as Error).message);
    }
  };
  return (
    <form class="rename" onSubmit={(event) => void save(event)}>
      <input
        aria-label="New name"
        value={typed}
        maxLength={200}
        onInput={(event) => setTyped(event.currentTarget.value)}
        onKeyDown={(event) => event.key === "Escape" && setTyped(null)}
        autofocus
      />
      <button class="primary" disabled={typed.trim() === ""}>
        Save
      </button>
      <button type="button" onClick={() => setTyped(null)}>
        Leave it
      </button>
      <Alert>{trouble}</Alert>
    </form>
  );
}

interface Deleting {
  kind: Kind;
  id: string;
  what: string; // this dataset
  onDeleted: () => void;
}

/** Deletes at the second click, beside words of what that means. */
export function DeleteButton({ kind, id, what, onDeleted }: Deleting) {
  const [asking, setAsking] = useState(false);
  const [trouble, setTrouble] = useState<string | null>(null);
  const go = async () => {
    try {
      await remove(kind, id);
      onDeleted();
    } catch (error) {
      setTrouble((error as Error).message);
      setAsking(false);
    }
  };
  return (
    <div class="deleting">
      {asking ? (
        <>
          <Meaning kind={kind} id={id} what={what} />
          <span class="buttons">
            <button class="danger" onClick={() => void go()}>
              Yes, delete it
            </button>
            <button onClick={() => setAsking(false)} autofocus>
              Keep it
            </button>
          </span>
        </>
      ) : (
        <button onClick={() => setAsking(true)}>
          <Icon name="bin" /> Delete {what}
        </button>
      )}
      <Alert>{trouble}</Alert>
    </div>
  );
}

function Meaning({ kind, id, what }: Pick<Deleting, "kind" | "id" | "what">) {
  const consequences = useConsequences(kind, [id]);
  return (
    <span role="alert">
      Delete {what} for good? {consequences}
    </span>
  );
}
