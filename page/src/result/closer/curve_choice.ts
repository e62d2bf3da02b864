/** Which curves there are: of what is selected, of joints by their names, of edges. */

import type { Take } from "../../data/take.ts";
import type { Theme } from "../../parts/theme.ts";
import {
  angleDeviations,
  coordinateDeviations,
  lengthDeviations,
  type Covariances,
} from "../../science/covariances.ts";
import { angles, coordinates, lengths, speeds } from "../../science/measures.ts";
import { edgeAngles, namedAngles, type Triple } from "../../science/named_angles.ts";

export interface Series {
  name: string;
  colour: keyof Theme;
  values: () => Float64Array; // (N,)
  deviations: ((covariances: Covariances | null) => Float64Array) | null; // (N,), NaN where not known; null: never known
}

export interface Curves {
  id: string;
  label: string;
  unit: string;
  possible: readonly [number, number]; // between which values can be
  apart?: readonly string[]; // what each series is called, where it has a scale of its own
  series: Series[];
}

export interface Group {
  label: string;
  curves: Curves[];
}

const COLOURS: (keyof Theme)[] = ["accent", "left", "right"];
const SIDES = { [-1]: "left", 0: "accent", 1: "right" } as const;
const MOST = 300; // edges, and angles of them, that are listed
const AXES = ["x", "y", "z"];
const ANY = [-Infinity, Infinity] as const;
const POSITIVE = [0, Infinity] as const;
const ANGLE = [0, 180] as const;

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
    ...angleGroups(take),
    {
      label: "Lengths of edges",
      curves: edges.slice(0, MOST).map(([a, b]): Curves => {
        const name = `${names[a]} – ${names[b]}`;
        return { id: `edge ${a} ${b}`, label: name, unit, possible: POSITIVE, series: [lengthOf(take, a, b)] };
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
  const position = AXES.map((name, axis): Series => {
    const values = () => coordinates(points, keypoints, last, axis);
    const deviations = (known: Covariances | null) => coordinateDeviationsOf(take, known, last, axis);
    return { name: `${names[last]} ${name}`, colour: COLOURS[axis]!, values, deviations };
  });
  const speed = selected.map((keypoint, index): Series => {
    const values = () => speeds(points, keypoints, keypoint, times);
    // Errors of neighbouring frames are alike: how much of them a difference keeps is not known.
    return { name: `${names[keypoint]} speed`, colour: COLOURS[index]!, values, deviations: null };
  });
  const perTime = `${unit} per ${times === null ? "frame" : "second"}`;
  const curves: Curves[] = [
    { id: "position", label: `Position of ${names[last]}`, unit, possible: ANY, apart: AXES, series: position },
    { id: "speed", label: `Speed of ${listed(take, selected)}`, unit: perTime, possible: POSITIVE, series: speed },
  ];
  if (b !== undefined && c === undefined) {
    const label = `Distance ${names[a]} – ${names[b]}`;
    curves.push({ id: "distance", label, unit, possible: POSITIVE, series: [lengthOf(take, a, b)] });
  }
  if (b !== undefined && c !== undefined) {
    const series = [angleOf(take, [a, b, c], names[b]!, "accent")];
    curves.push({ id: "angle", label: `Angle at ${names[b]}`, unit: "degrees", possible: ANGLE, series });
  }
  return curves;
}

/** Returns the angles of joints that have usual names, and those at other keypoints that two edges meet in. */
function angleGroups(take: Take): Group[] {
  const { names, sides, edges } = take;
  const ofAngles = (id: string, label: string, series: Series[]): Curves => {
    return { id, label, unit: "degrees", possible: ANGLE, series };
  };
  const named = namedAngles(names, sides);
  const joints = named.map(({ joint, left, right }) =>
    ofAngles(`joint ${joint}`, `${joint.slice(0, 1).toUpperCase()}${joint.slice(1)}`, [
      ...(left === null ? [] : [angleOf(take, left, `left ${joint}`, "left")]),
      ...(right === null ? [] : [angleOf(take, right, `right ${joint}`, "right")]),
    ]),
  );
  const taken = new Set(named.flatMap(({ left, right }) => [left?.[1], right?.[1]]));
  const others = edgeAngles(edges).filter(([, middle]) => !taken.has(middle));
  const atOthers = others.slice(0, MOST).map((triple) => {
    const [, middle] = triple;
    const series = [angleOf(take, triple, names[middle]!, SIDES[sides[middle]!])];
    return ofAngles(`angle ${middle}`, `Angle at ${names[middle]}`, series);
  });
  return [
    { label: "Angles of joints", curves: joints },
    { label: "Angles between edges", curves: atOthers },
  ];
}

function angleOf({ points, keypoints }: Take, [a, b, c]: Triple, name: string, colour: keyof Theme): Series {
  const values = () => angles(points, keypoints, a, b, c);
  const deviations = (known: Covariances | null) =>
    known === null ? unknown(points.length / (3 * keypoints)) : angleDeviations(points, known, keypoints, a, b, c);
  return { name: `${name} angle`, colour, values, deviations };
}

function lengthOf({ points, keypoints, names }: Take, a: number, b: number): Series {
  const values = () => lengths(points, keypoints, a, b);
  const deviations = (known: Covariances | null) =>
    known === null ? unknown(points.length / (3 * keypoints)) : lengthDeviations(points, known, keypoints, a, b);
  return { name: `${names[a]} – ${names[b]}`, colour: "accent", values, deviations };
}

/** Returns deviations along an axis or, where no covariance is known, those of errors that are as likely in every
 * direction. */
function coordinateDeviationsOf(take: Take, known: Covariances | null, keypoint: number, axis: number): Float64Array {
  const { deviations, keypoints, frames } = take;
  const along = known === null ? unknown(frames) : coordinateDeviations(known, keypoints, keypoint, axis);
  return along.map((value, frame) =>
    Number.isNaN(value) ? deviations[frame * keypoints + keypoint]! / Math.sqrt(3) : value,
  );
}

function unknown(frames: number): Float64Array {
  return new Float64Array(frames).fill(NaN);
}

function listed({ names }: Take, keypoints: readonly number[]): string {
  return keypoints.map((keypoint) => names[keypoint]).join(", ");
}
