/** What can be given of a result whether or not a finding asks for it: its unit, and which way is up. */

import { UpControl } from "./up.tsx";
import { Folded } from "./provider.tsx";
import { REMEDIES } from "./registry.ts";
import { useSubject } from "./subject.ts";

const ASKED = ["known_length", "known_distance", "handedness"] as const;

export function KnownPanel() {
  const { lifting } = useSubject();
  return (
    <section class="panel" aria-label="What you know of it">
      <h2>
        What you know of it <span class="quiet">its unit, its upright, its handedness</span>
      </h2>
      {ASKED.map((field) => {
        const { words, Control } = REMEDIES[field];
        return (
          <Folded key={field} words={words}>
            <Control />
          </Folded>
        );
      })}
      {lifting.frame !== undefined && (
        <Folded words="Show which way is up">
          <UpControl />
        </Folded>
      )}
    </section>
  );
}
