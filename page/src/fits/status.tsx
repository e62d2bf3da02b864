/** What has become of a fit, in a word. */

import type { Fit } from "../api/resources.ts";

const DOUBTS = { good: "", caution: ", with limits", serious: ", with serious doubts" };

export function Status({ fit }: { fit: Fit }) {
  const word = fit.cancel_requested && fit.status === "running" ? "being cancelled" : fit.status;
  const level = fit.verdict?.level ?? "good";
  return (
    <span class={`status ${fit.status} ${level}`} title={fit.verdict?.reliable}>
      {word}
      {DOUBTS[level]}
    </span>
  );
}
