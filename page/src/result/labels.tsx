/** Labels for the detector: the images that are worth a human's look, and files to train on. */

import { useState } from "preact/hooks";
import { askJson } from "../api/http.ts";
import type { components } from "../api/openapi.d.ts";
import { Downloads, type Entry } from "../parts/downloads.tsx";
import { number, words } from "../parts/format.ts";
import { useShow } from "./show.ts";

type FitLabels = components["schemas"]["FitLabels"];
type Reason = components["schemas"]["LabelReason"];

const LISTED = 12;
const NAMED = 3; // keypoints of a reason
const FORMATS = [
  ["DeepLabCut", "dlc"],
  ["to refine there", "dlc-machine"],
  ["COCO", "coco"],
  ["Lightning Pose", "lightning-pose"],
] as const;

export function Labels() {
  const { fit, editing } = useShow();
  const [found, setFound] = useState<FitLabels | null>(null);
  const [trouble, setTrouble] = useState<string | null>(null);
  const look = () =>
    askJson<FitLabels>(`fits/${fit.id}/labels?limit=${LISTED}`).then(setFound, (error: Error) =>
      setTrouble(error.message),
    );
  const entries = (images: string) =>
    FORMATS.map(([label, format]): Entry => {
      const path = `fits/${fit.id}/labels/file?format=${format}&images=${images}`;
      return [label, path, `${fit.id}-labels-${format}.zip`];
    });
  return (
    <details onToggle={(event) => event.currentTarget.open && found === null && void look()}>
      <summary>Labels for the detector</summary>
      {trouble !== null && (
        <p class="trouble" role="alert">
          {trouble}
        </p>
      )}
      {found !== null && <WorthLabelling found={found} />}
      <Downloads
        groups={[
          ...(found === null || found.images.length + editing.list.length === 0
            ? []
            : [["These, put right by the fit", entries("worth-labelling")] as [string, Entry[]]]),
          ["All keypoints that the fit accepts", entries("all")],
        ]}
      />
    </details>
  );
}

function WorthLabelling({ found }: { found: FitLabels }) {
  const { take, player } = useShow();
  if (found.images.length === 0) return <p class="quiet">No image stands out as worth labelling.</p>;
  const why = ({ code, keypoints }: Reason) => {
    const names = keypoints.slice(0, NAMED).map((keypoint) => take.names?.[keypoint] ?? `keypoint ${keypoint}`);
    if (keypoints.length > NAMED) names.push(`${keypoints.length - NAMED} more`);
    return [words(code), names.join(", ")].filter(Boolean).join(": ");
  };
  return (
    <table aria-label="Worth labelling">
      <thead>
        <tr>
          <th>Image</th>
          <th>Score</th>
          <th>Why</th>
        </tr>
      </thead>
      <tbody>
        {found.images.map(({ view, frame, moment, score, reasons }) => (
          <tr key={`${view} ${frame}`}>
            <td>
              <button class="chip" disabled={moment === null} onClick={() => player.show(moment ?? 0)}>
                {take.viewNames[view]}, frame {frame}
              </button>
            </td>
            <td>{number(score)}</td>
            <td>{reasons.map(why).join("; ")}</td>
          </tr>
        ))}
      </tbody>
    </table>
  );
}
