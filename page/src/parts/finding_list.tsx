/** What was noticed, in words, at the views, keypoints and frames it concerns. */

import { useContext } from "preact/hooks";
import type { Finding } from "../api/resources.ts";
import { number, words } from "./format.ts";
import { Icon } from "./icons.tsx";
import { RemedySlot } from "./remedy_slot.ts";

interface Known {
  viewNames?: readonly string[] | undefined;
  keypointNames?: readonly string[] | undefined;
  onFrame?: (frame: number) => void;
  onKeypoint?: (keypoint: number) => void;
}

const MOST = 12; // of a list before it is cut

/** @param calm whether nothing else that is shown gives cause for doubt: only then is it good news that
 * nothing was noticed */
export function FindingList({ findings, calm = false, ...known }: { findings: Finding[]; calm?: boolean } & Known) {
  const remedy = useContext(RemedySlot);
  if (findings.length === 0) {
    if (!calm) return null;
    return (
      <p class="quiet">
        <Icon name="check" /> Nothing was noticed that you should know of.
      </p>
    );
  }
  const order = [...findings].sort((a, b) => Number(a.severity === "info") - Number(b.severity === "info"));
  return (
    <ul class="findings">
      {order.map((finding, index) => (
        <li key={index} class={finding.severity}>
          <Icon name={finding.severity === "warning" ? "warning" : "info"} />
          <div>
            <strong>{words(finding.code)}</strong>{" "}
            {finding.evidence?.applied === 1 && <span class="chip">put right</span>}
            <Where finding={finding} {...known} />
            <p>{withCode(finding.effect)}</p>
            {finding.remedy !== "" && <p class="remedy">{withCode(finding.remedy)}</p>}
            {remedy?.(finding)}
            <Evidence numbers={finding.evidence ?? {}} />
          </div>
        </li>
      ))}
    </ul>
  );
}

function Where({ finding, viewNames, keypointNames, onFrame, onKeypoint }: { finding: Finding } & Known) {
  const views = finding.views ?? [];
  const keypoints = finding.keypoints ?? [];
  const frames = finding.frames ?? [];
  if (views.length + keypoints.length + frames.length === 0) return null;
  return (
    <p class="where">
      {views.map((view) => (
        <span class="chip" key={`v${view}`}>
          {viewNames?.[view] ?? `view ${view}`}
        </span>
      ))}
      {keypoints.slice(0, MOST).map((keypoint) => (
        <Chip key={`k${keypoint}`} onClick={onKeypoint && (() => onKeypoint(keypoint))}>
          {keypointNames?.[keypoint] ?? `keypoint ${keypoint}`}
        </Chip>
      ))}
      {frames.slice(0, MOST).map(([first, last]) => (
        <Chip key={`f${first}`} onClick={onFrame && (() => onFrame(first))}>
          {first === last ? `frame ${first}` : `frames ${first}–${last}`}
        </Chip>
      ))}
      {Math.max(keypoints.length, frames.length) > MOST && <span class="quiet">and more</span>}
    </p>
  );
}

function Chip({ children, onClick }: { children: preact.ComponentChildren; onClick?: (() => void) | undefined }) {
  if (onClick === undefined) return <span class="chip">{children}</span>;
  return (
    <button class="chip" onClick={onClick}>
      {children}
    </button>
  );
}

/** Shows as code what the words have between backticks. */
export function withCode(text: string) {
  return text.split("`").map((part, index) => (index % 2 === 1 ? <code key={index}>{part}</code> : part));
}

function Evidence({ numbers }: { numbers: Record<string, number> }) {
  const entries = Object.entries(numbers);
  if (entries.length === 0) return null;
  return (
    <p class="quiet evidence">
      {entries.map(([name, value]) => `${name.replaceAll("_", " ")} ${number(value)}`).join(" · ")}
    </p>
  );
}
