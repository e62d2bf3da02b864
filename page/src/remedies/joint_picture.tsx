/** A frame of a view as a picture whose keypoints can be clicked, or chosen with the keyboard. */

import { useState } from "preact/hooks";
import type { Drawn } from "../datasets/preview.ts";
import type { Side } from "../science/sides.ts";
import { Choice } from "./choice.tsx";

interface Props {
  picture: Drawn;
  names: readonly string[];
  viewNames: string[];
  edges: readonly (readonly [number, number])[];
  offered?: readonly (readonly [number, number])[]; // drawn dashed
  sides: readonly Side[];
  marked: readonly number[]; // keypoints, with their places in the list written beside them if numbered
  numbered?: boolean;
  onJoint: (keypoint: number) => void;
  onEdge?: (edge: readonly [number, number]) => void;
}

const WIDE = 400; // units of the picture's width; it is shown as wide as there is space
const HIGH = 300;
const MARGIN = 24;
const CLASSES = { "-1": "left", "0": "middle", "1": "right" } as const;

export function JointPicture(props: Props) {
  const { picture, names, viewNames, edges, offered = [], sides, marked, numbered = false, onJoint, onEdge } = props;
  const [view, setView] = useState(() => fullest(picture));
  const [near, setNear] = useState<number | null>(null); // the keypoint under the pointer, or focused
  const places = placesIn(picture.views[view] ?? new Float32Array());
  const line = ([a, b]: readonly [number, number]) => {
    const [from, to] = [places[a], places[b]];
    return from && to ? { x1: from[0], y1: from[1], x2: to[0], y2: to[1] } : null;
  };
  // Attributes of SVG are spelt as they are: `tabIndex` would be none.
  const press = (act: () => void) => (event: KeyboardEvent) => {
    if (event.key !== "Enter" && event.key !== " ") return;
    event.preventDefault();
    event.stopPropagation(); // Space would play
    act();
  };
  return (
    <div class="joint-picture">
      {viewNames.length > 1 && (
        <label>
          View{" "}
          <Choice
            value={`${view}`}
            choices={viewNames.map((name, index) => [`${index}`, name] as const)}
            onChange={(value) => setView(Number(value))}
          />
        </label>
      )}
      <svg viewBox={`0 0 ${WIDE} ${HIGH}`} role="group" aria-label="Keypoints of a frame">
        {offered.map((edge) => {
          const at = line(edge);
          return at && <line key={`offered ${edge.join()}`} class="offered" {...at} />;
        })}
        {edges.map((edge) => {
          const at = line(edge);
          if (at === null) return null;
          const key = edge.join();
          if (onEdge === undefined) return <line key={key} class="edge" {...at} />;
          const remove = () => onEdge(edge);
          return (
            <g
              key={key}
              class="edge"
              role="button"
              tabindex={0}
              aria-label={`Remove the edge from ${names[edge[0]]} to ${names[edge[1]]}`}
              onClick={remove}
              onKeyDown={press(remove)}
            >
              <line class="wide" {...at} />
              <line {...at} />
            </g>
          );
        })}
        {places.map((place, keypoint) => {
          if (place === null) return null;
          const order = marked.indexOf(keypoint);
          return (
            <g
              key={keypoint}
              class={`joint ${CLASSES[`${sides[keypoint] ?? 0}`]}${order >= 0 ? " marked" : ""}`}
              role="button"
              tabindex={0}
              aria-label={numbered && order >= 0 ? `${names[keypoint]}, ${order + 1}` : names[keypoint]}
              aria-pressed={order >= 0}
              onClick={() => onJoint(keypoint)}
              onKeyDown={press(() => onJoint(keypoint))}
              onMouseEnter={() => setNear(keypoint)}
              onMouseLeave={() => setNear(null)}
              onFocus={() => setNear(keypoint)}
              onBlur={() => setNear(null)}
            >
              <circle class="wide" cx={place[0]} cy={place[1]} r={9} />
              <circle cx={place[0]} cy={place[1]} r={4.5} />
              {numbered && order >= 0 && (
                <text x={place[0] + 8} y={place[1] - 6}>
                  {order + 1}
                </text>
              )}
            </g>
          );
        })}
      </svg>
      <p class="quiet near" aria-live="polite">
        {near === null ? "Point at a keypoint to see its name." : names[near]}
      </p>
    </div>
  );
}

/** Returns the view of a frame that shows most keypoints. */
function fullest({ views }: Drawn): number {
  const counts = views.map((pixels) => pixels.reduce((sum, value) => sum + (Number.isNaN(value) ? 0 : 1), 0));
  return Math.max(0, counts.indexOf(Math.max(...counts)));
}

/** Returns where each keypoint of (P, 2) pixels is in the picture; null where it was not observed. */
function placesIn(pixels: Float32Array): ([number, number] | null)[] {
  const points = Array.from({ length: pixels.length / 2 }, (_, keypoint): [number, number] => [
    pixels[2 * keypoint] ?? NaN,
    pixels[2 * keypoint + 1] ?? NaN,
  ]);
  const seen = points.filter(([x, y]) => Number.isFinite(x + y));
  const [xs, ys] = [seen.map(([x]) => x), seen.map(([, y]) => y)];
  const [left, top] = [Math.min(...xs), Math.min(...ys)];
  const [width, height] = [Math.max(...xs) - left || 1, Math.max(...ys) - top || 1];
  const scale = Math.min((WIDE - 2 * MARGIN) / width, (HIGH - 2 * MARGIN) / height);
  return points.map(([x, y]) =>
    Number.isFinite(x + y)
      ? [WIDE / 2 + scale * (x - left - width / 2), HIGH / 2 + scale * (y - top - height / 2)]
      : null,
  );
}
