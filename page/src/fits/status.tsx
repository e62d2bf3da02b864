/** What has become of a fit, in a word. */

import type { Fit } from "../api/resources.ts";

export function Status({ fit }: { fit: Fit }) {
  const word = fit.cancel_requested && fit.status === "running" ? "being cancelled" : fit.status;
  return <span class={`status ${fit.status}`}>{word}</span>;
}
