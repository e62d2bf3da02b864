/** Whom each view shows, as small pictures: one click for each view chooses the person. */

import { useEffect, useRef } from "preact/hooks";
import type { DatasetPreview } from "../api/resources.ts";
import { count } from "../parts/format.ts";
import { drawKeypoints } from "./preview.ts";

type ViewPeople = NonNullable<DatasetPreview["people"]>[number];
type Person = ViewPeople["people"][number];

interface PeopleProps {
  people: ViewPeople[];
  names: string[]; // of the views
  onChoose: (person: string) => void; // as the form has it: one for each view
}

export function People({ people, names, onChoose }: PeopleProps) {
  const choose = (view: number, one: Person) => {
    const others = people.map((each) => each.people.find(({ picked }) => picked) ?? each.people[0]);
    onChoose(others.map((other, at) => called(at === view ? one : other)).join(","));
  };
  return (
    <section class="panel people" aria-label="Who is it?">
      <h2>
        Who is it? <span class="quiet">Click the same person in each view, if another was taken.</span>
      </h2>
      {people.map((view, at) => (
        <div key={at} role="group" aria-label={names[at] ?? `view ${at}`}>
          <strong>{names[at] ?? `view ${at}`}</strong>
          {view.people.map((one, place) => (
            <button
              key={one.index}
              type="button"
              aria-pressed={one.picked}
              aria-label={`${one.name || `person ${place + 1}`}, ${names[at] ?? `view ${at}`}`}
              onClick={() => choose(at, one)}
            >
              <Thumbnail person={one} edges={view.edges} />
              <span class="quiet">
                {one.name} {count(one.frames, "frame")}
              </span>
            </button>
          ))}
        </div>
      ))}
    </section>
  );
}

/** Returns what the form calls somebody in a view. */
function called(person: Person | undefined): string {
  if (person === undefined) return "0";
  return person.name !== "" && !person.name.includes(",") ? person.name : `${person.index}`;
}

function Thumbnail({ person, edges }: { person: Person; edges: [number, number][] }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  useEffect(() => {
    if (canvas.current === null) return;
    const pixels = Float32Array.from(person.keypoints.flatMap((point) => point ?? [NaN, NaN]));
    drawKeypoints(canvas.current, { views: [pixels], edges, sides: [] }, 0);
    // eslint-disable-next-line react-hooks/exhaustive-deps -- edges come anew with each answer, and are the same
  }, [person]);
  return <canvas ref={canvas} role="img" aria-hidden="true" />;
}
