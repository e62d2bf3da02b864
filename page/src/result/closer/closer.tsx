/** Looking closer: some keypoints, what is measured between them. */

import { KeypointChoice } from "./keypoint_choice.tsx";

export function Closer() {
  return (
    <section class="panel closer" aria-label="Looking closer">
      <KeypointChoice />
    </section>
  );
}
