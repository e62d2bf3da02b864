/** What a fit can be given of the cameras: whether they move, and their focal lengths. */

import { useState } from "preact/hooks";
import type { components } from "../api/openapi.d.ts";
import { LensFields } from "../parts/lens_fields.tsx";
import { FitAgain, OneOf } from "./fit_again.tsx";
import { PerView } from "./per_view.tsx";
import { useSubject, viewNames } from "./subject.ts";

type Camera = components["schemas"]["Camera"];

const ARRANGEMENTS = [
  ["auto", "found out, view by view"],
  ["static", "static: no camera moves relative to the others"],
  ["moving", "moving: each may move from frame to frame"],
] as const;

const KINDS = [
  ["auto", "found out"],
  ["true", "alike: cameras of one model, at the same zoom"],
  ["false", "unlike: of several models, or at several zooms"],
] as const;

export function MendControl() {
  const undone = useSubject().fit?.config?.mend === "auto";
  return (
    <FitAgain
      words={undone ? "Fit again with the pixels as they are" : "Undo it, and fit again"}
      change={{ mend: undone ? "off" : "auto" }}
    />
  );
}

export function ArrangementControl() {
  const before = useSubject().fit?.config?.cameras ?? "auto";
  // The distance of cameras that move is none.
  const changeTo = (cameras: string) => ({ cameras, ...(cameras === "moving" && { known_distance: null }) });
  return <OneOf label="Cameras" choices={ARRANGEMENTS} before={before} changeTo={changeTo} />;
}

export function AlikeControl() {
  const before = `${useSubject().fit?.config?.cameras_alike ?? "auto"}`;
  const changeTo = (text: string) => ({ cameras_alike: text === "auto" ? text : text === "true" });
  return <OneOf label="Lenses" choices={KINDS} before={before} changeTo={changeTo} />;
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
      <PerView
        columns={[{ name: "Focal length", unit: "px", step: "any", hint: "not known" }]}
        texts={texts.map((text) => [text])}
        onText={(view, _, text) => setTexts(texts.map((old, at) => (at === view ? text : old)))}
      />
      <p class="quiet">
        Leave a field empty to have the camera estimated, and whatever was given of it left out. A calibration file can
        be given where the <a href={`#/datasets/${dataset.id}`}>dataset</a> is fitted.
      </p>
      <FitAgain change={changed ? { calibration: given ? calibration : null } : null} />
    </>
  );
}

export function KnownLensesControl() {
  const { dataset, fit } = useSubject();
  const before = fit?.config?.lenses ?? null;
  const [lenses, setLenses] = useState(before);
  return (
    <>
      <p>
        Of a phone's or a camera's data sheet, about: the main camera of most phones is as of 26 mm film, with video
        stabilisation about 30 mm.
      </p>
      <LensFields names={viewNames(dataset)} before={before} onChange={setLenses} />
      <FitAgain change={JSON.stringify(lenses) === JSON.stringify(before) ? null : { lenses }} />
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
