/** What a fit can be given of the subject: a length, and which way round it is. */

import { useState } from "preact/hooks";
import { percent } from "../parts/format.ts";
import { MeasuredFields, type Measured } from "../parts/measured_fields.tsx";
import { shareOfPositiveVolumes } from "../science/handedness.ts";
import { ChosenJoints, complete } from "./chosen_joints.tsx";
import { FitAgain } from "./fit_again.tsx";
import { useSubject, viewNames } from "./subject.ts";

export function LengthControl() {
  const before = useSubject().fit?.config?.known_length ?? null;
  const ends = (before?.keypoints ?? [null, null]) as (number | null)[];
  const [chosen, setChosen] = useState(ends);
  const [text, setText] = useState(`${before?.length ?? ""}`);
  const keypoints = complete(chosen);
  const length = Number(text);
  return (
    <>
      <p>Click the two ends of something that you have measured on the subject.</p>
      <ChosenJoints labels={["From", "To"]} before={ends} onChange={setChosen} />
      <label>
        Length <small class="quiet">in metres, say: it is the unit of all that comes out</small>{" "}
        <input
          type="number"
          min={0}
          step="any"
          placeholder="0.42"
          value={text}
          onInput={(event) => setText(event.currentTarget.value)}
        />
      </label>
      <FitAgain change={keypoints !== null && length > 0 ? { known_length: { keypoints, length } } : null} />
    </>
  );
}

export function DistanceControl() {
  const { dataset, fit } = useSubject();
  const before = fit?.config?.known_distance ?? null;
  const [distance, setDistance] = useState<Measured | null>(null);
  const known_distance = distance && { views: distance.ends, length: distance.length };
  return (
    <>
      <p>Of two cameras that do not move, from lens to lens. A known length of the subject goes before it.</p>
      <div class="measured-fields">
        <MeasuredFields
          of="camera"
          names={viewNames(dataset)}
          before={before && { ends: before.views, length: before.length }}
          onChange={setDistance}
        />
      </div>
      <FitAgain change={known_distance && { known_distance }} />
    </>
  );
}

const CORNERS = ["First", "Clockwise next", "Clockwise last", "In front, nearer to you"];

/** Returns keypoints a, b, c, d of positive volume, which `handedness` asks for. Of three that go round
 * clockwise for who looks at them, the cross product (b - a) x (c - a) points away from the viewer, in
 * a right-handed frame. With the first two exchanged it points to the viewer, where the fourth is. */
export function handednessOf([first, second, ...others]: readonly number[]): number[] {
  return [second, first, ...others].filter((each) => each !== undefined);
}

export function HandednessControl() {
  const { fit, take } = useSubject();
  const before = fit?.config?.handedness as number[] | null | undefined;
  const [b, a, c, d] = before ?? [null, null, null, null];
  const start = [a ?? null, b ?? null, c ?? null, d ?? null];
  const [chosen, setChosen] = useState<(number | null)[]>(start);
  const corners = complete(chosen);
  const agrees = take === null || corners === null ? NaN : shareOfPositiveVolumes(take, handednessOf(corners));
  return (
    <>
      <p>
        Think of the real subject, not of the picture in 3D, which may be mirrored. Choose three keypoints that go round{" "}
        <strong>clockwise</strong> as you look at the subject, and then one that lies <strong>in front</strong> of these
        three, nearer to you. For a person who faces you: the right shoulder, the left shoulder, the left hip, the nose.
        It should be so in most frames.
      </p>
      <ChosenJoints labels={CORNERS} before={start} onChange={setChosen} />
      {agrees >= 0 && (
        <p role="status">
          {agrees > 0.5
            ? "This fit has them so: it is the right way round."
            : "This fit has them the other way round: it is mirrored."}{" "}
          <span class="quiet">So in {percent(Math.max(agrees, 1 - agrees))} of the frames.</span>
        </p>
      )}
      <FitAgain change={corners === null ? null : { handedness: handednessOf(corners) }} />
    </>
  );
}
