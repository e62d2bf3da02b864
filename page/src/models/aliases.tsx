/** The aliases of a model: shown, added, moved here from another model, deleted. */

import { useEffect, useState } from "preact/hooks";
import { listAliases, listAll } from "../api/lists.ts";
import { deleteAlias, setAlias, type Alias, type Model } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";
import { moment } from "../parts/format.ts";
import { Icon } from "../parts/icons.tsx";

const EXAMPLE = "walk@production";

export function Aliases({ model }: { model: Model }) {
  const [all, setAll] = useState<Alias[]>([]);
  const [typed, setTyped] = useState("");
  const [trouble, setTrouble] = useState<string | null>(null);
  const look = () => listAll(listAliases).then(setAll, (error: Error) => setTrouble(error.message));
  useEffect(() => void look(), [model.id]);
  const change = async (work: Promise<unknown>) => {
    setTrouble(null);
    await work.then(
      () => setTyped(""),
      (error: Error) => setTrouble(error.message),
    );
    await look();
  };
  const mine = all.filter((alias) => alias.model_id === model.id);
  const elsewhere = all.find((alias) => alias.alias === typed && alias.model_id !== model.id);
  return (
    <>
      {mine.length > 0 && (
        <ul class="aliases">
          {mine.map(({ alias, moved_at: moved }) => (
            <li key={alias}>
              <code>{alias}</code>
              <span class="quiet">since {moment(moved)}</span>
              <button
                class="icons"
                aria-label={`Delete the alias ${alias}`}
                onClick={() => void change(deleteAlias(alias))}
              >
                <Icon name="close" />
              </button>
            </li>
          ))}
        </ul>
      )}
      <form
        class="rename"
        onSubmit={(event) => {
          event.preventDefault();
          void change(setAlias(typed, model.id));
        }}
      >
        <input
          aria-label="New alias"
          placeholder={EXAMPLE}
          value={typed}
          onInput={(event) => setTyped(event.currentTarget.value.trim())}
        />
        <button disabled={typed === ""}>{elsewhere ? "Move it here" : "Add"}</button>
        {elsewhere && <span class="quiet">It points to another model now.</span>}
      </form>
      <Alert>{trouble}</Alert>
    </>
  );
}
