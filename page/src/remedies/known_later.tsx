/** What is known of a dataset and was not given at its upload. */

import { useState } from "preact/hooks";
import { changeDataset } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";
import { goTo } from "../route.ts";
import { fitLike } from "./fit_again.tsx";
import { PerView } from "./per_view.tsx";
import { useSubject, viewNames } from "./subject.ts";
import { useAttempt } from "./use_attempt.ts";

type Size = [number, number];

const SIDES = ["Width", "Height"].map((name) => ({ name, unit: "px", step: 1 }));

export function RateControl() {
  const { dataset } = useSubject();
  const [text, setText] = useState(`${dataset.fps ?? ""}`);
  const fps = Number(text);
  return (
    <>
      <label>
        Frames per second{" "}
        <input type="number" min={0} step="any" value={text} onInput={(event) => setText(event.currentTarget.value)} />
      </label>
      <Save change={fps > 0 ? { fps } : null} />
    </>
  );
}

export function SizesControl() {
  const { dataset } = useSubject();
  const [texts, setTexts] = useState(() =>
    viewNames(dataset).map((_, view) => {
      const size = dataset.image_sizes?.[view];
      return [`${size?.[0] ?? ""}`, `${size?.[1] ?? ""}`];
    }),
  );
  /** Puts a side of a view's image; views of which nothing is known get the same. */
  const put = (view: number, side: number, text: string) => {
    const before = texts[view]?.[side];
    setTexts(
      texts.map((sides, index) =>
        index === view || sides[side] === before || sides[side] === ""
          ? sides.map((old, which) => (which === side ? text : old))
          : sides,
      ),
    );
  };
  const sizes = texts.map(([width, height]): Size | null =>
    Number(width) > 0 && Number(height) > 0 ? [Number(width), Number(height)] : null,
  );
  return (
    <>
      <PerView columns={SIDES} texts={texts} onText={put} />
      <Save change={sizes.some((size) => size !== null) ? { image_sizes: sizes } : null} />
    </>
  );
}

/** Stores a change of the dataset, and fits again if one likes. */
function Save({ change }: { change: Record<string, unknown> | null }) {
  const { dataset, fit, onDataset } = useSubject();
  const [saved, setSaved] = useState(false);
  const { busy, trouble, attempt } = useAttempt();
  const save = (then: () => Promise<void>) =>
    attempt(async () => {
      onDataset(await changeDataset(dataset.id, change ?? {}));
      setSaved(true);
      await then();
    });
  const waits = busy || change === null;
  return (
    <>
      <Alert>{trouble}</Alert>
      <div class="buttons">
        <button class={fit === null ? "primary" : ""} disabled={waits} onClick={() => save(async () => {})}>
          Save
        </button>
        {fit !== null && (
          <button
            class="primary"
            disabled={waits}
            onClick={() => save(async () => goTo("fits", (await fitLike(fit, {})).id))}
          >
            Save, and fit again
          </button>
        )}
        <span class="quiet" role="status">
          {saved && !busy ? "Saved." : ""}
        </span>
      </div>
    </>
  );
}
