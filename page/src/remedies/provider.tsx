/** Puts controls beside the remedies of findings, and gives them what they are about. */

import type { ComponentChildren } from "preact";
import { useState } from "preact/hooks";
import type { Finding } from "../api/resources.ts";
import { RemedySlot } from "../parts/remedy_slot.ts";
import { REMEDIES, type RemedyField } from "./registry.ts";
import { SubjectContext, useSubject, type Subject } from "./subject.ts";

export function Remediable({ subject, children }: { subject: Subject | null; children: ComponentChildren }) {
  if (subject === null) return <>{children}</>;
  const controls = (finding: Finding) => <Controls fields={finding.remedy_fields ?? []} />;
  return (
    <SubjectContext.Provider value={subject}>
      <RemedySlot.Provider value={controls}>{children}</RemedySlot.Provider>
    </SubjectContext.Provider>
  );
}

export function Controls({ fields }: { fields: readonly RemedyField[] }) {
  const subject = useSubject();
  return (
    <>
      {fields
        .map((field) => REMEDIES[field])
        .filter(({ suits }) => suits(subject))
        .map(({ words, Control, direct = false }) =>
          direct ? (
            <Control key={words} />
          ) : (
            <Folded key={words} words={words}>
              <Control />
            </Folded>
          ),
        )}
    </>
  );
}

/** A control behind words that open it, made when they are first opened. */
export function Folded({ words, children }: { words: string; children: ComponentChildren }) {
  const [opened, setOpened] = useState(false);
  return (
    <details class="remedy-control" onToggle={(event) => event.currentTarget.open && setOpened(true)}>
      <summary>{words}</summary>
      {opened && children}
    </details>
  );
}
