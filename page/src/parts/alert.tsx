/** What went wrong, in words, read out as it appears. */

import type { ComponentChildren } from "preact";

/** Shows nothing as long as there is nothing in it. */
export function Alert({ children }: { children: ComponentChildren }) {
  if (children === null || children === undefined || children === false) return null;
  return (
    <p class="trouble" role="alert">
      {children}
    </p>
  );
}

/** A screen whose subject is not there yet, or cannot be had. */
export function Waiting({ trouble }: { trouble: string | null }) {
  return (
    <main>
      {trouble === null && <p class="quiet">Loading …</p>}
      <Alert>{trouble}</Alert>
    </main>
  );
}
