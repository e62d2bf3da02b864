/** All models, the newest first, with their aliases and figures. */

import { useEffect, useState } from "preact/hooks";
import { listAliases, listAll, listModels } from "../api/lists.ts";
import type { Alias, ModelSummary } from "../api/resources.ts";
import { ListScreen, NewCapture, Warnings } from "../lists/list_screen.tsx";
import type { Column } from "../lists/table.tsx";
import { useList } from "../lists/use_list.ts";
import { moment, pixels } from "../parts/format.ts";
import { linkTo } from "../route.ts";

const COLUMNS: Column<ModelSummary>[] = [
  { title: "Frames", cell: ({ frames }) => frames?.toLocaleString("en") ?? "imported", order: (m) => m.frames ?? NaN },
  { title: "Views", cell: ({ views }) => views ?? "any", order: ({ views }) => views ?? NaN },
  { title: "Keypoints", cell: ({ keypoints }) => keypoints, order: ({ keypoints }) => keypoints },
  {
    title: "Error",
    cell: ({ reprojection_error: error }) => pixels(error),
    order: ({ reprojection_error: error }) => error ?? NaN,
  },
  {
    title: "Noticed",
    cell: ({ findings }) => <Warnings findings={findings} />,
    order: ({ findings }) => findings.length,
  },
  { title: "Version", cell: ({ version }) => version ?? "–", order: ({ version }) => version ?? "" },
  { title: "Made", cell: ({ created_at: at }) => moment(at), order: ({ created_at: at }) => Date.parse(at) },
];

export function ModelsScreen() {
  const list = useList(listModels);
  const [aliases, setAliases] = useState<Alias[]>([]);
  useEffect(() => {
    listAll(listAliases).then(
      setAliases,
      () => {}, // the list does without
    );
  }, []);
  return (
    <ListScreen
      kind="models"
      title="Models"
      list={list}
      columns={COLUMNS}
      beside={<span class="quiet">What fits made: each lifts new frames of its keypoints in milliseconds.</span>}
      teach={<Teach />}
      under={(model) => <AliasList aliases={aliases.filter((alias) => alias.model_id === model.id)} />}
    />
  );
}

function AliasList({ aliases }: { aliases: Alias[] }) {
  return (
    <>
      {aliases.map(({ alias }) => (
        <span class="chip" key={alias}>
          {alias}
        </span>
      ))}
    </>
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
