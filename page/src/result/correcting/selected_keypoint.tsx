/** What is known of the selected keypoint in the frame that is shown, a view at a time. */

import type { Correction } from "../../data/corrections.ts";
import { ALL } from "../../data/take.ts";
import { useShow } from "../show.ts";
import { useFrame } from "../use_frame.ts";

export function SelectedKeypoint() {
  const { take, selected, editing, version } = useShow();
  const frame = useFrame();
  const keypoint = selected.at(-1);
  if (keypoint === undefined) return <p class="quiet">Select a keypoint: click it, in a view or in 3D.</p>;
  if (take.there[frame] !== ALL) return null;
  return (
    <table class="of-keypoint" data-version={version}>
      <caption>
        {take.names[keypoint]} in frame {frame}
      </caption>
      <tbody>
        {take.viewNames.map((name, view) => {
          const place = { frame, view, keypoint };
          const correction = editing.at(place);
          const at = 2 * ((frame * take.views + view) * take.keypoints + keypoint);
          const there = !Number.isNaN(take.detected[at]!);
          return (
            <tr key={view} aria-current={view === editing.view}>
              <th scope="row">{name}</th>
              <td>{inWords(correction, there)}</td>
              <td>
                <span class="buttons">
                  <button disabled={!there} onClick={() => editing.put(place, null)}>
                    Remove <span class="unseen">it from {name}</span>
                  </button>
                  <button disabled={correction === undefined} onClick={() => editing.put(place, undefined)}>
                    As detected <span class="unseen">in {name}</span>
                  </button>
                </span>
              </td>
            </tr>
          );
        })}
      </tbody>
    </table>
  );
}

function inWords(correction: Correction | undefined, there: boolean): string {
  if (correction === undefined) return there ? "detected" : "not detected";
  return correction.position === null ? "removed" : "corrected";
}
