/** What may be relied on of a fit, as the service judges it by its findings. */

import type { ComponentChildren } from "preact";
import type { Fit } from "../api/resources.ts";
import { withCode } from "./finding_list.tsx";
import { Icon } from "./icons.tsx";

interface Props {
  verdict: Fit["verdict"];
  framesDoubted: boolean; // whether something was noticed of single frames, which the fit's verdict does not know
  children?: ComponentChildren; // what leads to more
}

export function Verdict({ verdict, framesDoubted, children }: Props) {
  if (verdict === null || verdict === undefined) return null;
  const good = verdict.level === "good" && !framesDoubted;
  const words = verdict.level === "good" && framesDoubted ? "Rely on it but for the frames below." : verdict.reliable;
  return (
    <p class={`verdict ${good ? "good" : verdict.level === "good" ? "caution" : verdict.level}`} role="status">
      <Icon name={good ? "check" : "warning"} /> <strong>{withCode(words)}</strong>
      {verdict.expected && <> {verdict.expected}</>}
      {verdict.remedy !== "" && <> What would help: {withCode(verdict.remedy)}</>}
      {children}
    </p>
  );
}
