/** Whether single letters and digits do something by themselves: who dictates, or types by accident, can
 * switch that off (WCAG 2.1.4). The choice stays in this browser. */

import { useState } from "preact/hooks";

const PLACE = "fewview-single-keys";

export function singleKeysAct(): boolean {
  return localStorage.getItem(PLACE) !== "off";
}

export function KeyChoice() {
  const [on, setOn] = useState(singleKeysAct);
  const choose = (next: boolean) => {
    localStorage.setItem(PLACE, next ? "on" : "off");
    setOn(next);
  };
  return (
    <label class="choice">
      <input type="checkbox" checked={on} onChange={(event) => choose(event.currentTarget.checked)} />
      Letters and digits act by themselves
    </label>
  );
}

/** Returns whether a key is the business of the control that has the focus, or of the browser. */
export function isTaken(event: KeyboardEvent): boolean {
  if (event.ctrlKey || event.metaKey || event.altKey) return true;
  if (/^\S$/.test(event.key) && !singleKeysAct()) return true;
  const at = event.target instanceof Element ? event.target : null;
  if (at === null) return false;
  if (at.closest("input:not([type=range],[type=checkbox],[type=radio]),select,textarea,[contenteditable]")) return true;
  if (event.key === " " || event.key === "Enter") {
    return at.closest("button,a[href],summary,input[type=checkbox],input[type=radio],[role=button]") !== null;
  }
  const moves = /^(Arrow|Home|End|Page)/.test(event.key);
  return moves && at.closest("input[type=radio],input[type=range]:not([data-frames]),[role=listbox]") !== null;
}
