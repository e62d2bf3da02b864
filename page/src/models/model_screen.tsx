/** One model: its figures, where it comes from, what programs call it, and how to take it away. */

import { useEffect, useState } from "preact/hooks";
import { listAll, listFits } from "../api/lists.ts";
import { getCameras, getFit, getModel, type Fit, type Model, type ModelCameras } from "../api/resources.ts";
import { Tags } from "../lists/tags.tsx";
import { Curve } from "../fits/curve.tsx";
import { Waiting } from "../parts/alert.tsx";
import { FigureList } from "../parts/figure_list.tsx";
import { FindingList } from "../parts/finding_list.tsx";
import { bytes, count, moment, number, percent, pixels } from "../parts/format.ts";
import { Downloads } from "../parts/downloads.tsx";
import { DeleteButton, NamedHeading } from "../parts/named.tsx";
import { goTo, linkTo } from "../route.ts";
import { Aliases } from "./aliases.tsx";
import { downloadsOf } from "./downloads.ts";

export function ModelScreen({ id }: { id: string }) {
  const [model, setModel] = useState<Model | null>(null);
  const [cameras, setCameras] = useState<ModelCameras | null>(null);
  const [trouble, setTrouble] = useState<string | null>(null);
  useEffect(() => {
    getModel(id).then(setModel, (error: Error) => setTrouble(error.message));
    getCameras(id).then(setCameras, () => {}); // the figures do without
  }, [id]);
  useEffect(() => {
    document.title = `${model?.name ?? "Model"} · Fewview`;
  }, [model?.name]);
  if (model === null) return <Waiting trouble={trouble} />;
  const curve = model.training_curve.flatMap(({ step, reprojection_error: error }) => (error ? [{ step, error }] : []));
  return (
    <main>
      <header class="title">
        <NamedHeading kind="models" id={model.id} name={model.name} onName={(name) => setModel({ ...model, name })} />
        <span class="quiet id">{model.id}</span>
      </header>
      <Tags key={model.id} kind="models" id={model.id} tags={model.tags} />
      <div class="facts-grid halves">
        <section class="panel">
          <h2>Figures</h2>
          <Figures model={model} cameras={cameras} />
        </section>
        <section class="panel">
          <h2>Where it comes from</h2>
          <Lineage model={model} />
        </section>
      </div>
      <section class="panel">
        <h2>
          Aliases <span class="quiet">what programs ask for, whichever model it is just now</span>
        </h2>
        <Aliases model={model} />
      </section>
      {curve.length > 1 && (
        <section class="panel">
          <h2>How the error fell</h2>
          <Curve steps={curve.at(-1)?.step ?? 1} rows={curve} />
        </section>
      )}
      <section class="panel">
        <h2>What was noticed</h2>
        <FindingList calm findings={model.findings} keypointNames={model.skeleton?.keypoint_names ?? undefined} />
      </section>
      <section class="panel">
        <h2>Take it away</h2>
        <Downloads groups={downloadsOf(model.id, cameras)} />
        <DeleteButton kind="models" id={model.id} what="this model" onDeleted={() => goTo("models")} />
      </section>
    </main>
  );
}

function Figures({ model, cameras }: { model: Model; cameras: ModelCameras | null }) {
  const rows: [string, string][] = [
    ["Reprojection error", pixels(model.reprojection_error)],
    ["Frames lifted", model.frames ? `${number(model.frames_lifted)} of ${number(model.frames)}` : "–"],
    ["Keypoints", `${model.keypoints}${model.views ? ` of ${count(model.views, "view")}` : ""}`],
    ["Cameras", cameras === null ? "–" : cameras.arrangement],
    ["Version of Fewview", model.version ?? "not known"],
    ["Weights", bytes(model.weights_bytes)],
  ];
  if (model.pa_mpjpe) rows.push(["Error against the truth", `${number(model.pa_mpjpe)}, PA-MPJPE in the truth's unit`]);
  if (model.pck) rows.push(["PCK", `${percent(model.pck)} within ${number(model.pck_threshold)} of the truth`]);
  return <FigureList rows={rows} />;
}

/** From which dataset, by which fit, begun with which model; and which fits began with this one. */
function Lineage({ model }: { model: Model }) {
  const [fit, setFit] = useState<Fit | null>(null);
  const [children, setChildren] = useState<Fit[]>([]);
  useEffect(() => {
    if (model.fit_id) getFit(model.fit_id).then(setFit, () => {}); // it was deleted
    listAll(listFits, { from_model: model.id }).then(setChildren, () => {});
  }, [model.id, model.fit_id]);
  return (
    <dl class="figures">
      <div>
        <dt>Made</dt>
        <dd>{moment(model.created_at)}</dd>
      </div>
      <div>
        <dt>By</dt>
        <dd>{model.fit_id ? <a href={linkTo("fits", model.fit_id)}>its fit, with the result</a> : "an import"}</dd>
      </div>
      {model.dataset_id && (
        <div>
          <dt>Of</dt>
          <dd>
            <a href={linkTo("datasets", model.dataset_id)}>its dataset</a>
          </dd>
        </div>
      )}
      {fit?.from_model && (
        <div>
          <dt>Begun with</dt>
          <dd>
            <a href={linkTo("models", fit.from_model)}>another model</a>
          </dd>
        </div>
      )}
      {children.length > 0 && (
        <div>
          <dt>Fits begun with it</dt>
          <dd>
            {children.map((child) => (
              <a key={child.id} class="chip" href={linkTo("fits", child.id)}>
                {child.name}
              </a>
            ))}
          </dd>
        </div>
      )}
      <div>
        <dt>Watch it</dt>
        <dd>
          <a href={linkTo("live")}>live</a>
        </dd>
      </div>
    </dl>
  );
}
