/** What is laid over the structure, pale: the ground truth, or what another fit made of the dataset. */

import { useEffect, useState } from "preact/hooks";
import { listAll, listFits } from "../api/lists.ts";
import { getFit, getModel, type Fit, type Model } from "../api/resources.ts";
import { loadPoints } from "../data/loading.ts";
import { aligned } from "../science/aligning.ts";
import { useShow } from "./show.ts";

export interface Overlay {
  name: string;
  points: Float32Array; // (N, P, 3), moved onto the structure
  each: boolean; // whether each frame was moved on its own, not all as one
  model: Model | null; // that made them
}

const NONE = "";
const TRUTH = "truth";

export function OverlayChoice() {
  const { fit, take, file, done, overlay, setOverlay } = useShow();
  const [others, setOthers] = useState<Fit[]>([]);
  const [chosen, setChosen] = useState(NONE);
  const [trouble, setTrouble] = useState(false);
  useEffect(() => {
    listAll(listFits, { dataset_id: fit.dataset_id, status: "succeeded" }).then(
      (found) => setOthers(found.filter((other) => other.id !== fit.id && other.model_id)),
      () => setOthers([]),
    );
  }, [fit.id, fit.dataset_id]);
  if (others.length === 0 && !take.hasTruth) return null;

  const lay = async (choice: string) => {
    setChosen(choice);
    setTrouble(false);
    if (choice === NONE) return setOverlay(null);
    try {
      const other = others.find(({ id }) => id === choice);
      const name = other === undefined ? "the truth" : `${other.name} (${other.id.slice(-6)})`;
      const { points, inOneFrame } =
        choice === TRUTH ? { points: await file.truth(), inOneFrame: true } : await loadPoints(await getFit(choice));
      const each = take.frame === "view" || !inOneFrame;
      const model = other?.model_id ? await getModel(other.model_id) : null;
      setOverlay({ name, each, model, points: aligned(points, take.points, take.keypoints, each) });
    } catch {
      setTrouble(true);
    }
  };
  return (
    <select
      aria-label="Laid over the structure"
      value={chosen}
      disabled={!done}
      data-state={overlay === null ? "none" : "shown"}
      onChange={(event) => void lay(event.currentTarget.value)}
    >
      <option value={NONE}>{trouble ? "cannot be loaded" : "compare with …"}</option>
      {take.hasTruth && <option value={TRUTH}>the ground truth</option>}
      {others.map((other) => (
        <option key={other.id} value={other.id}>
          {other.name} ({other.id.slice(-6)})
        </option>
      ))}
    </select>
  );
}
