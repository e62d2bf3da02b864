/** Which keypoints are selected, and a list of all in which one seeks by typing. */

import { useState } from "preact/hooks";
import { Icon } from "../../parts/icons.tsx";
import { useShown } from "../show.ts";

const LIST = "keypoint-names";

export function KeypointChoice() {
  const { take, selected, select, setSelected } = useShown();
  const [typed, setTyped] = useState("");
  const [unknown, setUnknown] = useState(false);
  const choose = (keypoint: number) => {
    setUnknown(keypoint < 0);
    if (keypoint < 0) return;
    if (!selected.includes(keypoint)) select(keypoint, true);
    setTyped("");
  };
  return (
    <div class="keypoint-choice">
      <form
        onSubmit={(event) => {
          event.preventDefault();
          if (typed.trim() !== "") choose(named(take.names, typed));
        }}
      >
        <label>
          Select a keypoint
          <input
            list={LIST}
            value={typed}
            autocomplete="off"
            placeholder="type its name"
            aria-invalid={unknown}
            onInput={(event) => {
              const { value } = event.currentTarget;
              setTyped(value);
              setUnknown(false);
              // A name that was typed may go on: of k1 to k10.
              if (!isTyped(event) && take.names.includes(value)) choose(take.names.indexOf(value));
            }}
          />
        </label>
        <datalist id={LIST}>
          {take.names.map((name, keypoint) => (
            <option key={keypoint} value={name} />
          ))}
        </datalist>
      </form>
      {selected.map((keypoint) => (
        <button class="chip" key={keypoint} onClick={() => select(keypoint, true)}>
          {take.names[keypoint]} <Icon name="close" />
          <span class="unseen">: no longer select it</span>
        </button>
      ))}
      {selected.length > 1 && (
        <button class="plain" onClick={() => setSelected([])}>
          Select none
        </button>
      )}
      {unknown && (
        <span class="quiet" role="alert">
          “{typed}” is in the name of no keypoint, or of several.
        </span>
      )}
    </div>
  );
}

/** Returns whether a letter was typed, and not an entry of the list taken. */
function isTyped(event: Event): boolean {
  const how = event instanceof InputEvent ? event.inputType : "";
  return how !== "" && how !== "insertReplacementText";
}

/** Returns the keypoint of a name, or the only one whose name has a text in it; -1 without one. */
function named(names: readonly string[], typed: string): number {
  const sought = typed.trim().toLowerCase();
  const lower = names.map((name) => name.toLowerCase());
  if (lower.includes(sought)) return lower.indexOf(sought);
  const holding = lower.filter((name) => name.includes(sought));
  return holding.length === 1 ? lower.indexOf(holding[0]!) : -1;
}
