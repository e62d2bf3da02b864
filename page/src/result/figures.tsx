/** How good the fit is, and what was estimated of the cameras. */

import { Curve } from "../fits/curve.tsx";
import { count, number, percent, pixels } from "../parts/format.ts";
import { distances } from "../science/aligning.ts";
import { pairAt } from "../science/pairs.ts";
import { useShow } from "./show.ts";

export function Figures() {
  const { model, unit, cameras, take, overlay } = useShow();
  const rows: [string, string, string?][] = [
    ["Captured", `${count(take.views, "view")}, ${count(take.keypoints, "keypoint")}`],
    ["Lengths", unit],
  ];
  if (cameras.noise) rows.unshift(["Noise of keypoints", pixels(cameras.noise), "standard deviation"]);
  if (model !== null) {
    rows.unshift(["Reprojection error", pixels(model.reprojection_error), "mean over the views of all frames"]);
    rows.splice(-2, 0, ["Frames lifted", `${number(model.frames_lifted)} of ${number(take.frames)}`]);
  }
  if (overlay !== null) {
    const off = distances(take.points, overlay.points, take.keypoints).filter(Number.isFinite);
    const mean = off.reduce((sum, value) => sum + value, 0) / Math.max(1, off.length);
    const how = overlay.each ? "each frame on its own" : "all frames as one";
    rows.push([`Distance from ${overlay.name}`, number(mean), `mean, moved onto it ${how}`]);
    if (overlay.model !== null) {
      rows.splice(1, 0, [`of ${overlay.name}`, pixels(overlay.model.reprojection_error), "of another fit"]);
    }
  }
  if (model?.pa_mpjpe) {
    rows.push(["Error against the truth", number(model.pa_mpjpe), "PA-MPJPE, in the truth's unit"]);
  }
  if (model?.pck) {
    rows.push(["PCK", percent(model.pck), `within ${number(model.pck_threshold)} of the truth`]);
  }
  return (
    <>
      <dl class="figures">
        {rows.map(([name, value, note]) => (
          <div key={name}>
            <dt>{name}</dt>
            <dd>
              {value}
              {note !== undefined && <small class="quiet"> {note}</small>}
            </dd>
          </div>
        ))}
      </dl>
      <CameraTable />
      {model !== null && model.training_curve.length > 1 && (
        <details class="training">
          <summary>How the error fell</summary>
          <Curve
            steps={model.training_curve.at(-1)?.step ?? 1}
            rows={model.training_curve.flatMap(({ step, reprojection_error: error }) =>
              error ? [{ step, error }] : [],
            )}
          />
        </details>
      )}
    </>
  );
}

function CameraTable() {
  const { cameras, take, lookThrough, posed, findings } = useShow();
  const notEverywhere = findings.some(({ code }) => code === "rig_not_used");
  if (cameras.views.length === 0) return <p class="quiet">{cameras.reason}</p>;
  return (
    <>
      <table>
        <caption class="quiet">
          Cameras: {cameras.arrangement}. {cameras.reason}
          {notEverywhere && ". In some frames they do not fit, and are not used: see what was noticed"}
        </caption>
        <thead>
          <tr>
            <th scope="col">view</th>
            <th scope="col">lens</th>
            <th scope="col">focal length</th>
            <th scope="col">error</th>
          </tr>
        </thead>
        <tbody>
          {cameras.views.map((view) => (
            <tr key={view.index}>
              <th scope="row">
                {posed[view.index] ? (
                  <button class="plain" onClick={() => lookThrough(view.index)}>
                    {take.viewNames[view.index]}
                  </button>
                ) : (
                  take.viewNames[view.index]
                )}
              </th>
              <td>
                {view.camera.replaceAll("_", " ")}, {view.static ? "static" : "moving"}
              </td>
              <td>
                {view.focal ? `${Math.round(pairAt(view.focal, 0)[0])} px` : "–"}
                {view.focal_sd ? <small class="quiet"> ± {number(view.focal_sd, 2)}</small> : null}
              </td>
              <td>{pixels(view.reprojection_error)}</td>
            </tr>
          ))}
        </tbody>
      </table>
    </>
  );
}
