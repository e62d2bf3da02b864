/** All models, the newest first, with their aliases and figures. */

import { useEffect, useState } from "preact/hooks";
import { listAliases, listModels, type Alias, type ModelSummary } from "../api/resources.ts";
import { count, moment, pixels } from "../parts/format.ts";
import { Icon } from "../parts/icons.tsx";
import { useList } from "../parts/use_list.ts";
import { linkTo } from "../route.ts";

export function ModelsScreen() {
  const { items, trouble, more } = useList(listModels);
  const [aliases, setAliases] = useState<Alias[]>([]);
  useEffect(() => {
    document.title = "Models · Fewview";
    listAliases().then(
      (page) => setAliases(page.items),
      () => {}, // the list does without
    );
  }, []);
  return (
    <main>
      <header class="title">
        <h1>Models</h1>
        <span class="quiet">What fits made: each lifts new frames of its keypoints in milliseconds.</span>
      </header>
      {trouble !== null && (
        <p class="trouble" role="alert">
          {trouble}
        </p>
      )}
      {items?.length === 0 && (
        <section class="panel teach">
          <h2>A model knows one subject, and perhaps its cameras</h2>
          <p>
            Every fit that succeeds leaves one here. You take it away as weights or ONNX, give it an alias such as{" "}
            <code>walk@production</code> for programs to ask for, or <a href={linkTo("live")}>watch it live</a>.
          </p>
          <a class="button primary" href={linkTo("datasets", "new")}>
            <Icon name="plus" /> Start with a capture
          </a>
        </section>
      )}
      <ul class="list">
        {items?.map((model) => (
          <li key={model.id}>
            <ModelRow model={model} aliases={aliases.filter((alias) => alias.model_id === model.id)} />
          </li>
        ))}
      </ul>
      {more !== null && <button onClick={more}>Older models</button>}
    </main>
  );
}

function ModelRow({ model, aliases }: { model: ModelSummary; aliases: Alias[] }) {
  const of = [model.views ? count(model.views, "view") : null, count(model.keypoints, "keypoint")].filter(Boolean);
  const warnings = model.findings.filter(({ severity }) => severity === "warning").length;
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
        {warnings > 0 && (
          <span class="warned">
            <Icon name="warning" /> {count(warnings, "warning")}
          </span>
        )}
        {model.reprojection_error ? <span>{pixels(model.reprojection_error)}</span> : null}
        <span class="quiet">{moment(model.created_at)}</span>
      </span>
    </a>
  );
}
