/** The views of a new capture: renamed, put in another order, left out. */

import { Icon } from "../parts/icons.tsx";

/** A view that is wanted: what the files call it, and what it shall be called. */
export interface WantedView {
  source: string;
  name: string;
}

export function Views({ views, onChange }: { views: WantedView[]; onChange: (views: WantedView[]) => void }) {
  const swap = (at: number, other: number) => {
    const next = [...views];
    const [one, two] = [views[at], views[other]];
    if (one === undefined || two === undefined) return;
    next[at] = two;
    next[other] = one;
    onChange(next);
  };
  return (
    <ol class="wanted-views" aria-label="Views, in this order">
      {views.map((view, at) => (
        <li key={view.source}>
          <input
            aria-label={`Name of view ${view.source}`}
            value={view.name}
            maxLength={200}
            onInput={(event) => {
              const name = event.currentTarget.value;
              onChange(views.map((each) => (each === view ? { ...each, name } : each)));
            }}
          />
          <button
            type="button"
            class="icons"
            disabled={at === 0}
            aria-label={`Put ${view.source} before the one above`}
            onClick={() => swap(at, at - 1)}
          >
            ↑
          </button>
          <button
            type="button"
            class="icons"
            disabled={views.length === 1}
            aria-label={`Leave out view ${view.source}`}
            onClick={() => onChange(views.filter((each) => each !== view))}
          >
            <Icon name="close" />
          </button>
        </li>
      ))}
    </ol>
  );
}
