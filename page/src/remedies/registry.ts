/** The control of each remedy, by the field that findings name: `RemedyField` in `models/findings/remedies.py`.
 * A field without one is an error of types. */

import type { FunctionComponent } from "preact";
import type { Finding } from "../api/resources.ts";
import { AlikeControl, ArrangementControl, KnownLensesControl, LensControl, MendControl } from "./cameras.tsx";
import { RateControl, SizesControl } from "./known_later.tsx";
import { FrameControl, RefineControl, ViewsControl } from "./lifting.tsx";
import { DistanceControl, HandednessControl, LengthControl } from "./measures.tsx";
import { FromModelControl, MirrorControl } from "./other_captures.tsx";
import type { Subject } from "./subject.ts";

export type RemedyField = NonNullable<Finding["remedy_fields"]>[number];

interface Remedy {
  words: string; // on what opens the control
  Control: FunctionComponent;
  direct?: boolean; // whether it is one button, which need not be opened
  suits: (subject: Subject) => boolean; // whether it can be taken there
}

const always = () => true;
const ofFit = ({ fit }: Subject) => fit !== null;

export const REMEDIES: Record<RemedyField, Remedy> = {
  fps: { words: "Give the frame rate", Control: RateControl, suits: always },
  image_sizes: { words: "Give the image sizes", Control: SizesControl, suits: always },
  mirror: { words: "Have mirrored views read so", Control: MirrorControl, suits: always },
  mend: { words: "Have it undone", Control: MendControl, direct: true, suits: ofFit },
  cameras: { words: "Choose whether cameras move", Control: ArrangementControl, suits: ofFit },
  cameras_alike: { words: "Choose whether lenses are alike", Control: AlikeControl, suits: ofFit },
  lenses: { words: "Give what is known of the lenses", Control: KnownLensesControl, suits: ofFit },
  calibration: { words: "Give focal lengths", Control: LensControl, suits: ofFit },
  known_length: { words: "Give a known length", Control: LengthControl, suits: ofFit },
  known_distance: { words: "Give the distance of two cameras", Control: DistanceControl, suits: ofFit },
  handedness: { words: "Show which way round it is", Control: HandednessControl, suits: ofFit },
  from_model: {
    words: "Fit a capture from this model",
    Control: FromModelControl,
    suits: ({ model }) => model !== null,
  },
  frame: {
    words: "Choose the frame of reference",
    Control: FrameControl,
    suits: ({ lifting }) => lifting.frame !== undefined,
  },
  refine: {
    words: "Choose the refinement",
    Control: RefineControl,
    suits: ({ fit, lifting }) => fit !== null || lifting.refine !== undefined,
  },
  views: {
    words: "Choose which camera each view is of",
    Control: ViewsControl,
    suits: ({ lifting }) => lifting.views !== undefined,
  },
};
