/** Why there is no result, and what to do. */

import type { Fit } from "../api/resources.ts";
import { FindingList } from "../parts/finding_list.tsx";
import { Remediable } from "../remedies/provider.tsx";
import { useSubjectOf } from "../remedies/use_subject_of.ts";
import { linkTo } from "../route.ts";

const WHAT_TO_DO: Record<string, string> = {
  dataset_not_found: "The dataset was deleted. Upload the capture again, and fit that.",
  model_not_found: "The model it was to start from was deleted. Fit again without from_model.",
  unusable_capture: "Look at the dataset: which keypoints and views it has, and in how many frames.",
  object_damaged: "A stored file is damaged. Upload the capture again; fewview doctor examines the rest.",
  invalid_arguments: "Mend what is named above, and fit again.",
  timed_out: "Give it a smaller budget_s or fewer steps, or its worker more time.",
  worker_lost: "Its workers ended again and again, for want of memory perhaps. Fit fewer frames, or see the log.",
  internal_error: "That is a mistake of Fewview. The service's log has more; fit again, or report it.",
};

export function Failure({ fit }: { fit: Fit }) {
  const cancelled = fit.status === "cancelled";
  return (
    <section class="panel empty" role="status">
      <h2>{cancelled ? "This fit was cancelled" : "This fit failed"}</h2>
      {fit.error && <p>{fit.error.message}</p>}
      <p>{cancelled ? "What it had computed was dropped." : (WHAT_TO_DO[fit.error?.code ?? ""] ?? "")}</p>
      <Remediable subject={useSubjectOf(fit)}>
        <FindingList findings={fit.findings} />
      </Remediable>
      <a class="button primary" href={linkTo("datasets", fit.dataset_id)}>
        To its dataset, to fit it again
      </a>
    </section>
  );
}
