/** What a fit can be given of the cameras: whether they move, and their focal lengths. */

import { useState } from "preact/hooks";
import type { components } from "../api/openapi.d.ts";
import { FitAgain } from "./fit_again.tsx";
import { useSubject, viewNames } from "./subject.ts";

type Camera = components["schemas"]["Camera"];

const ARRANGEMENTS = [
  ["auto", "found out, view by view"],
  ["static", "static: no camera moves relative to the others"],
  ["moving", "moving: each may move from frame to frame"],
] as const;

export function ArrangementControl() {
  const { fit } = useSubject();
  const before = fit?.config?.cameras ?? "auto";
  const [cameras, setCameras] = useState<string>(before);
  return (
    <>
      <label>
        Cameras{" "}
        <select value={cameras} onChange={(event) => setCameras(event.currentTarget.value)}>
          {ARRANGEMENTS.map(([value, label]) => (
            <option key={value} value={value}>
              {label}
            </option>
          ))}
        </select>
      </label>
      <FitAgain change={cameras === before ? null : { cameras }} />
    </>
  );
}

export function LensControl() {
  const { dataset, fit } = useSubject();
  const before = fit?.config?.calibration ?? null;
  const [texts, setTexts] = useState(() =>
    viewNames(dataset).map((_, view) => `${before?.[view]?.intrinsics?.fx ?? ""}`),
  );
  const calibration = texts.map((text, view) => cameraWith(before?.[view] ?? null, Number(text)));
  const changed = texts.some((text, view) => text !== `${before?.[view]?.intrinsics?.fx ?? ""}`);
  const given = calibration.some((camera) => camera !== null);
  return (
    <>
      <table class="per-view">
        <thead>
          <tr>
            <th>View</th>
            <th>Focal length, px</th>
          </tr>
        </thead>
        <tbody>
          {viewNames(dataset).map((name, view) => (
            <tr key={view}>
              <td>{name}</td>
              <td>
                <input
                  aria-label={`Focal length of ${name}`}
                  type="number"
                  min={1}
                  step="any"
                  placeholder="not known"
                  value={texts[view] ?? ""}
                  onInput={(event) => setTexts(texts.map((old, at) => (at === view ? event.currentTarget.value : old)))}
                />
              </td>
            </tr>
          ))}
        </tbody>
      </table>
      <p class="quiet">
        Leave a field empty to have the camera estimated, and whatever was given of it left out. A calibration file can
        be given where the <a href={`#/datasets/${dataset.id}`}>dataset</a> is fitted.
      </p>
      <FitAgain change={changed ? { calibration: given ? calibration : null } : null} />
    </>
  );
}

/** Returns a camera with another focal length; null without one. */
function cameraWith(camera: Camera | null, fx: number): Camera | null {
  if (!(fx > 0)) return null;
  if (camera?.intrinsics?.fx === fx) return camera;
  const intrinsics = { ...camera?.intrinsics, fx };
  delete intrinsics.fy; // it was the other's
  return { ...camera, intrinsics };
}
