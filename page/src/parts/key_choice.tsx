/** Whether single letters and digits do something by themselves: who dictates, or types by accident, can
 * switch that off (WCAG 2.1.4). The choice stays in this browser. */

import { kept, useKept } from "./kept.ts";

const PLACE = "single-keys";

export function KeyChoice() {
  const [chosen, choose] = useKept(PLACE, "on");
  return (
    <label class="choice">
      <input
        type="checkbox"
        checked={chosen !== "off"}
        onChange={(event) => choose(event.currentTarget.checked ? "on" : "off")}
      />
      Letters and digits act by themselves
    </label>
  );
}

/** Returns whether a key is the business of the control that has the focus, or of the browser. */
export function isTaken(event: KeyboardEvent): boolean {
  if (event.ctrlKey || event.metaKey || event.altKey) return true;
  if (/^\S$/.test(event.key) && kept(PLACE, "on") === "off") return true;
  const at = event.target instanceof Element ? event.target : null;
  if (at === null) return false;
  if (at.closest("input:not([type=range],[type=checkbox],[type=radio]),select,textarea,[contenteditable]")) return true;
  if (event.key === " " || event.key === "Enter") {
    return at.closest("button,a[href],summary,input[type=checkbox],input[type=radio],[role=button]") !== null;
  }
  const moves = /^(Arrow|Home|End|Page)/.test(event.key);
  return moves && at.closest("input[type=radio],input[type=range]:not([data-frames]),[role=listbox]") !== null;
}
