/** All models, the newest first, with their aliases and figures. */

import { useEffect, useState } from "preact/hooks";
import { listAliases, listModels, type Alias, type ModelSummary } from "../api/resources.ts";
import { count, moment, pixels } from "../parts/format.ts";
import { ListScreen, NewCapture, Warnings } from "../parts/list_screen.tsx";
import { useList } from "../parts/use_list.ts";
import { linkTo } from "../route.ts";

export function ModelsScreen() {
  const list = useList(listModels);
  const [aliases, setAliases] = useState<Alias[]>([]);
  useEffect(() => {
    listAliases().then(
      (page) => setAliases(page.items),
      () => {}, // the list does without
    );
  }, []);
  return (
    <ListScreen
      title="Models"
      list={list}
      beside={<span class="quiet">What fits made: each lifts new frames of its keypoints in milliseconds.</span>}
      teach={<Teach />}
      row={(model) => <ModelRow model={model} aliases={aliases.filter((alias) => alias.model_id === model.id)} />}
    />
  );
}

function Teach() {
  return (
    <section class="panel teach">
      <h2>A model knows one subject, and perhaps its cameras</h2>
      <p>
        Every fit that succeeds leaves one here. You take it away as weights or ONNX, give it an alias such as{" "}
        <code>walk@production</code> for programs to ask for, or <a href={linkTo("live")}>watch it live</a>.
      </p>
      <NewCapture>Start with a capture</NewCapture>
    </section>
  );
}

function ModelRow({ model, aliases }: { model: ModelSummary; aliases: Alias[] }) {
  const of = [model.views ? count(model.views, "view") : null, count(model.keypoints, "keypoint")].filter(Boolean);
  return (
    <a class="panel row" href={linkTo("models", model.id)}>
      <strong>{model.name}</strong>
      <span class="quiet">
        {of.join(", ")}
        {model.frames ? `, fitted to ${count(model.frames, "frame")}` : ", imported"}
      </span>
      <span class="facts">
        {aliases.map(({ alias }) => (
          <span class="chip" key={alias}>
            {alias}
          </span>
        ))}
        <Warnings findings={model.findings} />
        {model.reprojection_error ? <span>{pixels(model.reprojection_error)}</span> : null}
        <span class="quiet">{moment(model.created_at)}</span>
      </span>
    </a>
  );
}
