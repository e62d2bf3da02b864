/** Small helps beside the result: frames to look at first, a link, the keys. */

import { useState } from "preact/hooks";
import { number } from "../parts/format.ts";
import { Icon } from "../parts/icons.tsx";
import { KeyChoice } from "../parts/key_choice.tsx";
import { keepInAddress } from "../route.ts";
import { SHORTCUTS } from "./keys.ts";
import type { Stage } from "./scene/scene.ts";
import { useShow } from "./show.ts";

/** The frames in which the structure fits least to what was detected. */
export function WorstFrames() {
  const { worst, means, player } = useShow();
  if (worst.length === 0) return null;
  return (
    <p class="where worst-frames">
      <span class="quiet">Look first at frame</span>
      {worst.slice(0, 6).map((frame) => (
        <button class="chip" key={frame} onClick={() => player.show(frame)}>
          {frame} <span class="quiet">{number(means[frame])} px</span>
        </button>
      ))}
    </p>
  );
}

export function CopyLink({ stage, frame }: { stage: Stage | null; frame: () => number }) {
  const [copied, setCopied] = useState(false);
  const copy = async () => {
    const query: Record<string, string> = { frame: `${frame()}` };
    if (stage !== null)
      query.angle = stage
        .angle()
        .map((value) => value.toPrecision(5))
        .join(",");
    keepInAddress(query);
    try {
      await navigator.clipboard.writeText(location.href);
      setCopied(true);
      setTimeout(() => setCopied(false), 3000);
    } catch {
      setCopied(false); // not allowed here: the address bar has the link
    }
  };
  return (
    <div class="exports">
      <span>A link to this frame and angle</span>
      <span class="buttons">
        <button onClick={() => void copy()}>
          <Icon name={copied ? "check" : "link"} /> {copied ? "Copied" : "Copy link"}
        </button>
      </span>
    </div>
  );
}

export function Shortcuts() {
  return (
    <details>
      <summary>Keys</summary>
      <KeyChoice />
      <dl class="keys">
        {SHORTCUTS.map(([key, what]) => (
          <div key={key}>
            <dt>
              <kbd>{key}</kbd>
            </dt>
            <dd>{what}</dd>
          </div>
        ))}
      </dl>
    </details>
  );
}
