/** A skeleton that is being drawn: names of keypoints and edges, changed a step at a time. */

import type { KnownSkeleton } from "../api/resources.ts";
import { numbered } from "../data/capture.ts";

export interface Draft {
  readonly names: readonly string[];
  readonly edges: readonly (readonly [number, number])[];
}

const UNNAMED = "keypoint";
const LEAST_SHARED = 3; // names by which a ready skeleton of another count fits

export function draftOf(names: readonly string[] | null | undefined, edges: Draft["edges"], keypoints: number): Draft {
  return { names: names ?? numbered(UNNAMED, keypoints), edges };
}

/** Joins two keypoints, or parts those that are joined. */
export function toggled(draft: Draft, a: number, b: number): Draft {
  const others = draft.edges.filter(([from, to]) => !(from === a && to === b) && !(from === b && to === a));
  const edges = others.length < draft.edges.length ? others : [...others, [a, b] as const];
  return { ...draft, edges };
}

export function renamed(draft: Draft, keypoint: number, name: string): Draft {
  return { ...draft, names: draft.names.map((old, index) => (index === keypoint ? name : old)) };
}

/** Names two keypoints as the left and the right one of a pair, after what the first is called. */
export function paired(draft: Draft, left: number, right: number): Draft {
  const plain = (draft.names[left] ?? "").replace(/^(left|right)_|_(left|right)$/i, "");
  const base = plain.startsWith(`${UNNAMED} `) ? plain.replace(`${UNNAMED} `, "") : plain;
  return renamed(renamed(draft, left, `left_${base}`), right, `right_${base}`);
}

/** Adds edges; those that are there stay. */
export function joined(draft: Draft, edges: Draft["edges"]): Draft {
  const known = new Set(draft.edges.map(keyOf));
  return { ...draft, edges: [...draft.edges, ...edges.filter((edge) => !known.has(keyOf(edge)))] };
}

/** Returns a draft like a ready skeleton: of the same count by the order of its keypoints, else by
 * names that both have; null if it does not fit. */
export function like(draft: Draft, known: KnownSkeleton): Draft | null {
  const places = new Map(draft.names.map((name, index) => [plain(name), index]));
  const own = known.keypoint_names.map((name) => places.get(plain(name)));
  const shared = own.filter((place) => place !== undefined).length;
  const same = known.keypoint_names.length === draft.names.length;
  if (same && shared < draft.names.length) {
    return { names: known.keypoint_names, edges: known.edges as [number, number][] };
  }
  if (!same && shared < LEAST_SHARED) return null;
  const edges = known.edges.flatMap(([a, b]): [number, number][] => {
    const [from, to] = [own[a ?? -1], own[b ?? -1]];
    return from === undefined || to === undefined ? [] : [[from, to]];
  });
  return { ...draft, edges };
}

/** Returns what keeps a draft from being stored; null if nothing does. */
export function problemOf({ names }: Draft): string | null {
  const empty = names.findIndex((name) => name.trim() === "");
  if (empty >= 0) return `Keypoint ${empty} has no name.`;
  const twice = names.find((name, index) => names.indexOf(name) !== index);
  return twice === undefined ? null : `Two keypoints are called ${twice}: give them different names.`;
}

/** Returns the skeleton as the service takes it: keypoints that nobody named have no names. */
export function skeletonOf({ names, edges }: Draft) {
  const unnamed = names.every((name, index) => name === `${UNNAMED} ${index}`);
  return { keypoint_names: unnamed ? null : names.map((name) => name.trim()), edges };
}

function keyOf([a, b]: readonly [number, number]): string {
  return `${Math.min(a, b)} ${Math.max(a, b)}`;
}

function plain(name: string): string {
  return name.toLowerCase().replace(/[^\p{L}\p{N}]/gu, "");
}
