/** Puts controls beside the remedies of findings, and gives them what they are about. */

import type { ComponentChildren } from "preact";
import type { Finding } from "../api/resources.ts";
import { RemedySlot } from "../parts/remedy_slot.ts";
import { REMEDIES } from "./registry.ts";
import { SubjectContext, type Subject } from "./subject.ts";

export function Remediable({ subject, children }: { subject: Subject | null; children: ComponentChildren }) {
  if (subject === null) return <>{children}</>;
  const controls = (finding: Finding) => <Controls fields={finding.remedy_fields ?? []} ofFit={subject.fit !== null} />;
  return (
    <SubjectContext.Provider value={subject}>
      <RemedySlot.Provider value={controls}>{children}</RemedySlot.Provider>
    </SubjectContext.Provider>
  );
}

/** @param ofFit whether there is a fit to be made again */
export function Controls({ fields, ofFit }: { fields: readonly string[]; ofFit: boolean }) {
  return (
    <>
      {fields.map((field) => {
        const remedy = REMEDIES[field];
        if (remedy === undefined || (remedy.ofFit && !ofFit)) return null;
        return (
          <details class="remedy-control" key={field}>
            <summary>{remedy.words}</summary>
            <remedy.Control />
          </details>
        );
      })}
    </>
  );
}
