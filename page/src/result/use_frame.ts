/** The frame that is shown, for what is drawn anew at each. */

import { useEffect, useState } from "preact/hooks";
import { useShown } from "./show.ts";

/** Returns the frame that is shown, which playing changes. */
export function useFrame(): number {
  const { player } = useShown();
  const [frame, setFrame] = useState(player.frame);
  useEffect(() => {
    setFrame(player.frame);
    return player.onChange(() => setFrame(player.frame));
  }, [player]);
  return frame;
}
