/** Looking closer: some keypoints, what is measured of them, and curves over all frames. */

import { CurvePanel } from "./curves.tsx";
import { KeypointChoice } from "./keypoint_choice.tsx";
import { Measured } from "./measured.tsx";

export function Closer() {
  return (
    <section class="panel closer" aria-label="Looking closer">
      <KeypointChoice />
      <Measured />
      <CurvePanel />
    </section>
  );
}
