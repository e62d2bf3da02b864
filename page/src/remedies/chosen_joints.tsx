/** Keypoints that are chosen one after the other: clicked in a picture or in 3D, or from lists. */

import { useEffect, useState } from "preact/hooks";
import { sidesOf } from "../science/sides.ts";
import { Choice } from "./choice.tsx";
import { JointPicture } from "./joint_picture.tsx";
import { keypointNames, useSubject, viewNames } from "./subject.ts";

interface Props {
  labels: readonly string[]; // what each keypoint is
  before: readonly (number | null)[];
  onChange: (chosen: (number | null)[]) => void;
}

export function ChosenJoints({ labels, before, onChange }: Props) {
  const { dataset, picture, selected } = useSubject();
  const [chosen, setChosen] = useState<(number | null)[]>([...before]);
  const [seen, setSeen] = useState(selected); // of the clicks elsewhere, the last that counted
  const names = keypointNames(dataset);
  const change = (next: (number | null)[]) => {
    setChosen(next);
    onChange(next);
  };
  const click = (keypoint: number) => {
    const at = chosen.indexOf(keypoint);
    const empty = chosen.indexOf(null);
    if (at >= 0) change(chosen.map((old) => (old === keypoint ? null : old)));
    else if (empty >= 0) change(chosen.map((old, index) => (index === empty ? keypoint : old)));
    else change(chosen.map((_, index) => (index === 0 ? keypoint : null))); // begins anew
  };
  useEffect(() => {
    if (selected === seen) return;
    setSeen(selected);
    if (selected !== null && !chosen.includes(selected)) click(selected);
    // eslint-disable-next-line react-hooks/exhaustive-deps -- each click counts once, whatever was chosen since
  }, [selected]);
  return (
    <>
      {picture !== null && (
        <JointPicture
          picture={picture}
          names={names}
          viewNames={viewNames(dataset)}
          edges={(dataset.skeleton?.edges ?? []) as [number, number][]}
          sides={sidesOf(names)}
          marked={chosen.filter((each) => each !== null)}
          numbered
          onJoint={click}
        />
      )}
      <div class="chosen-joints">
        {labels.map((label, index) => (
          <label key={label}>
            {label}{" "}
            <Choice
              value={`${chosen[index] ?? ""}`}
              choices={[["", "–"], ...names.map((name, keypoint) => [`${keypoint}`, name] as const)]}
              onChange={(value) =>
                change(chosen.map((old, at) => (at === index ? (value === "" ? null : Number(value)) : old)))
              }
            />
          </label>
        ))}
      </div>
    </>
  );
}

/** Returns keypoints that are all chosen and all different; null otherwise. */
export function complete(chosen: readonly (number | null)[]): number[] | null {
  const all = chosen.filter((each) => each !== null);
  return all.length === chosen.length && new Set(all).size === all.length ? all : null;
}
