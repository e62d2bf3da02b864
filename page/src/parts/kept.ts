/** Choices that stay in this browser. */

import { useState } from "preact/hooks";

/** Returns what was chosen at a place, or what holds until something is. */
export function kept(place: string, usual: string): string {
  return localStorage.getItem(`fewview-${place}`) ?? usual;
}

/** Returns the same, and what changes it. */
export function useKept(place: string, usual: string): [string, (choice: string) => void] {
  const [chosen, setChosen] = useState(() => kept(place, usual));
  const choose = (choice: string) => {
    localStorage.setItem(`fewview-${place}`, choice);
    setChosen(choice);
  };
  return [chosen, choose];
}
