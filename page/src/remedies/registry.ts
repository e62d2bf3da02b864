/** The controls of remedies, by the fields that findings name (`RemedyField` in the catalogue of
 * findings). A test compares them. */

import type { FunctionComponent } from "preact";
import { ArrangementControl, LensControl } from "./cameras.tsx";
import { RateControl, SizesControl } from "./known_later.tsx";
import { HandednessControl, LengthControl } from "./measures.tsx";

interface Remedy {
  words: string; // on what opens the control
  Control: FunctionComponent;
  ofFit: boolean; // whether it is given to a fit; else to the dataset
}

export const REMEDIES: Record<string, Remedy> = {
  fps: { words: "Give the frame rate", Control: RateControl, ofFit: false },
  image_sizes: { words: "Give the image sizes", Control: SizesControl, ofFit: false },
  cameras: { words: "Choose whether cameras move", Control: ArrangementControl, ofFit: true },
  calibration: { words: "Give focal lengths", Control: LensControl, ofFit: true },
  known_length: { words: "Give a known length", Control: LengthControl, ofFit: true },
  handedness: { words: "Show which way round it is", Control: HandednessControl, ofFit: true },
};
