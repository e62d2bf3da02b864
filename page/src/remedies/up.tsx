/** Which way is up, by two keypoints one of which is above the other. */

import { useEffect, useState } from "preact/hooks";
import { getCameras, type ModelCameras } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";
import { directionInRoom } from "../science/upright.ts";
import { ChosenJoints, complete } from "./chosen_joints.tsx";
import { ShowAgain } from "./lifting.tsx";
import { useSubject } from "./subject.ts";
import { useAttempt } from "./use_attempt.ts";

const NOTHING = [null, null];

export function UpControl() {
  const { model, take } = useSubject();
  const [cameras, setCameras] = useState<ModelCameras | null>(null);
  const [chosen, setChosen] = useState<(number | null)[]>(NOTHING);
  const { trouble, attempt } = useAttempt();
  useEffect(() => {
    if (model !== null) attempt(async () => setCameras(await getCameras(model)));
    // eslint-disable-next-line react-hooks/exhaustive-deps -- asked once for each model
  }, [model]);
  const view = cameras?.views.find((each) => each.static && each.rotation);
  if (cameras !== null && view === undefined) {
    return <p>No camera is known to be static, so there is no room in which one direction is up.</p>;
  }
  const ends = complete(chosen);
  const [low, high] = ends ?? [];
  const up =
    take === null || low === undefined || high === undefined || !view?.rotation
      ? null
      : directionInRoom(take, [low, high], view.index, view.rotation);
  return (
    <>
      <p>
        Choose two keypoints one of which is straight above the other, in the mean of all frames: of a person who stands
        or walks, an ankle and the head. The structure is then turned, here and in what you save.
      </p>
      <ChosenJoints labels={["Lower", "Upper"]} before={NOTHING} onChange={setChosen} />
      <Alert>{trouble ?? (ends !== null && cameras !== null && up === null ? "No frame shows both." : null)}</Alert>
      <ShowAgain change={up === null ? null : { frame: "room", up }} />
    </>
  );
}
