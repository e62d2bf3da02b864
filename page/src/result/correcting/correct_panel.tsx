/** Correcting keypoints: the worst frames, what is selected in one of them, and fitting again. */

import { useLayoutEffect } from "preact/hooks";
import { Alert } from "../../parts/alert.tsx";
import { count, number } from "../../parts/format.ts";
import { Icon } from "../../parts/icons.tsx";
import { isTaken } from "../../parts/key_choice.tsx";
import { fitLike } from "../../remedies/fit_again.tsx";
import { useAttempt } from "../../remedies/use_attempt.ts";
import { goTo } from "../../route.ts";
import { farthestOf } from "../../science/farthest.ts";
import { afterInWorst } from "../keys.ts";
import { useShow } from "../show.ts";
import { useFrame } from "../use_frame.ts";
import { SelectedKeypoint } from "./selected_keypoint.tsx";

export function CorrectPanel() {
  const { editing, player, setSelected, take } = useShow();
  const { on, setOn, list, undoable, undoLast, trouble, saving } = editing;
  const undo = () => {
    const place = undoLast();
    if (place === null) return;
    player.playing = false;
    player.show(place.frame);
    setSelected([place.keypoint]);
    editing.setView(place.view);
  };
  const go = (to: number) => {
    player.playing = false;
    player.show(to);
    const farthest = farthestOf(take, to);
    if (farthest === null) return;
    setSelected([farthest.keypoint]);
    editing.setView(farthest.view);
  };
  useEditingKeys(undo, go);
  return (
    <section class="panel correcting" aria-label="Correct keypoints">
      <div class="buttons">
        <button aria-pressed={on} onClick={() => setOn(!on)}>
          <Icon name="pen" /> Correct keypoints
        </button>
        {(on || undoable) && (
          <button disabled={!undoable} onClick={undo} title="Ctrl+Z">
            Undo
          </button>
        )}
        <span class="quiet" role="status">
          {saving ? "Saving …" : list.length > 0 ? `${count(list.length, "keypoint")} corrected in this dataset` : ""}
        </span>
      </div>
      <Alert>{trouble}</Alert>
      {on && (
        <>
          <p class="quiet">
            Drag a keypoint in a view to its place. What was detected is kept, and can be brought back. Keys: W goes to
            the next of the worst frames, Delete removes the selected keypoint, and arrows move it in the view that has
            the focus.
          </p>
          <WorstToCorrect go={go} />
          <SelectedKeypoint />
        </>
      )}
      <Again />
    </section>
  );
}

/** The worst frames, each with what was corrected in it.
 *
 * @param go shows a frame, with the keypoint selected that is farthest from where it should be */
function WorstToCorrect({ go }: { go: (frame: number) => void }) {
  const { worst, means, editing } = useShow();
  const frame = useFrame();
  if (worst.length === 0) return null;
  const corrected = (at: number) => editing.list.filter((each) => each.frame === at).length;
  return (
    <div class="worst-list">
      <span id="worst-to-correct">The worst frames</span>
      <ol aria-labelledby="worst-to-correct">
        {worst.map((each) => (
          <li key={each}>
            <button class="chip" aria-current={each === frame} onClick={() => go(each)}>
              {each} <span class="quiet">{number(means[each])} px</span>
              {corrected(each) > 0 && (
                <>
                  <Icon name="check" />
                  <span class="unseen">, {corrected(each)} corrected</span>
                </>
              )}
            </button>
          </li>
        ))}
      </ol>
    </div>
  );
}

/** Whether the fit knows the corrections, and a fit that does. */
function Again() {
  const { fit, editing } = useShow();
  const { list, outdated, saving } = editing;
  const { busy, trouble, attempt } = useAttempt();
  const known = fit.corrections.count;
  if (!outdated) {
    return known > 0 && !saving ? <p class="quiet">This fit was made with {count(known, "correction")}.</p> : null;
  }
  const what = list.length > 0 ? `Fit again with ${count(list.length, "correction")}` : "Fit again without corrections";
  return (
    <>
      <Alert>{trouble}</Alert>
      <div class="buttons">
        <button
          class="primary"
          disabled={busy}
          onClick={() => attempt(async () => goTo("fits", (await fitLike(fit, {})).id))}
        >
          {what}
        </button>
        <span class="quiet">
          This fit was made {known > 0 ? `with ${known}` : "without any"}: its 3D and its errors do not know of changes
          since. It stays.
        </span>
      </div>
    </>
  );
}

/** Listens to the keys that correct. */
function useEditingKeys(undo: () => void, go: (frame: number) => void): void {
  const { editing, selected, player, worst } = useShow();
  useLayoutEffect(() => {
    if (!editing.on) return undefined;
    const listen = (event: KeyboardEvent) => {
      const undoes = (event.ctrlKey || event.metaKey) && !event.shiftKey && event.key.toLowerCase() === "z";
      const typing = event.target instanceof Element && event.target.closest("input,select,textarea") !== null;
      if (undoes ? typing : isTaken(event)) return;
      const keypoint = selected.at(-1);
      const next = afterInWorst(player, worst, event.shiftKey ? -1 : 1);
      if (undoes) undo();
      else if (event.key.toLowerCase() === "w" && next !== undefined) go(next);
      else if ((event.key === "Delete" || event.key === "Backspace") && keypoint !== undefined) {
        editing.put({ frame: player.frame, view: editing.view, keypoint }, null);
      } else return;
      event.preventDefault();
      event.stopPropagation(); // the screen's own keys do less
    };
    window.addEventListener("keydown", listen, { capture: true });
    return () => window.removeEventListener("keydown", listen, { capture: true });
  });
}
