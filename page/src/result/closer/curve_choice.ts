/** Which curves there are: of what is selected, of joints by their names, of edges. */

import type { Take } from "../../data/take.ts";
import { angles, coordinates, lengths, speeds } from "../../science/measures.ts";
import { namedAngles, type Triple } from "../../science/named_angles.ts";
import type { Theme } from "../../parts/theme.ts";

export interface Series {
  name: string;
  colour: keyof Theme;
  values: () => Float64Array; // (N,)
}

export interface Curves {
  id: string;
  label: string;
  unit: string;
  series: Series[];
}

export interface Group {
  label: string;
  curves: Curves[];
}

const COLOURS: (keyof Theme)[] = ["accent", "left", "right"];
const MOST_EDGES = 300; // that are listed

/** @param unit of lengths; @param times (N,) of the frames, in seconds, if they are known */
export function curveGroups(
  take: Take,
  selected: readonly number[],
  unit: string,
  times: ArrayLike<number> | null,
): Group[] {
  const { names, edges } = take;
  const groups = [
    { label: "What is selected", curves: ofSelected(take, selected, unit, times) },
    { label: "Angles of joints", curves: ofJoints(take) },
    {
      label: "Lengths of edges",
      curves: edges.slice(0, MOST_EDGES).map(([a, b]): Curves => {
        const name = `${names[a]} – ${names[b]}`;
        return { id: `edge ${a} ${b}`, label: name, unit, series: [lengthOf(take, a, b)] };
      }),
    },
  ];
  return groups.filter(({ curves }) => curves.length > 0);
}

function ofSelected(take: Take, selected: readonly number[], unit: string, times: ArrayLike<number> | null): Curves[] {
  const { points, keypoints, names } = take;
  const [a, b, c] = selected;
  const last = selected.at(-1);
  if (a === undefined || last === undefined) return [];
  const position = ["x", "y", "z"].map((axis, index): Series => {
    const values = () => coordinates(points, keypoints, last, index);
    return { name: `${names[last]} ${axis}`, colour: COLOURS[index]!, values };
  });
  const speed = selected.map((keypoint, index): Series => {
    const values = () => speeds(points, keypoints, keypoint, times);
    return { name: `${names[keypoint]} speed`, colour: COLOURS[index]!, values };
  });
  const perTime = `${unit} per ${times === null ? "frame" : "second"}`;
  const curves: Curves[] = [
    { id: "position", label: `Position of ${names[last]}`, unit, series: position },
    { id: "speed", label: `Speed of ${listed(take, selected)}`, unit: perTime, series: speed },
  ];
  if (b !== undefined && c === undefined) {
    curves.push({ id: "distance", label: `Distance ${names[a]} – ${names[b]}`, unit, series: [lengthOf(take, a, b)] });
  }
  if (b !== undefined && c !== undefined) {
    const series = [angleOf(take, [a, b, c], names[b]!, "accent")];
    curves.push({ id: "angle", label: `Angle at ${names[b]}`, unit: "degrees", series });
  }
  return curves;
}

function ofJoints(take: Take): Curves[] {
  return namedAngles(take.names, take.sides).map(({ joint, left, right }) => ({
    id: `joint ${joint}`,
    label: `${joint.slice(0, 1).toUpperCase()}${joint.slice(1)}`,
    unit: "degrees",
    series: [
      ...(left === null ? [] : [angleOf(take, left, `left ${joint}`, "left")]),
      ...(right === null ? [] : [angleOf(take, right, `right ${joint}`, "right")]),
    ],
  }));
}

function angleOf({ points, keypoints }: Take, [a, b, c]: Triple, name: string, colour: keyof Theme): Series {
  return { name: `${name} angle`, colour, values: () => angles(points, keypoints, a, b, c) };
}

function lengthOf({ points, keypoints, names }: Take, a: number, b: number): Series {
  const values = () => lengths(points, keypoints, a, b);
  return { name: `${names[a]} – ${names[b]}`, colour: "accent", values };
}

function listed({ names }: Take, keypoints: readonly number[]): string {
  return keypoints.map((keypoint) => names[keypoint]).join(", ");
}
