/** Some fits beside each other: their figures, and the settings in which they differ. */

import { useEffect, useState } from "preact/hooks";
import { listDatasets, listFits, listModels, listThese } from "../api/lists.ts";
import type { Dataset, Fit, ModelSummary } from "../api/resources.ts";
import { Waiting } from "../parts/alert.tsx";
import { count, duration, moment, number, pixels } from "../parts/format.ts";
import { currentRoute, linkTo } from "../route.ts";
import { compared, secondsOf } from "./settings.ts";
import { Status } from "./status.tsx";

const MOST = 6; // beside each other

export function linkToComparison(ids: string[]): string {
  return `${linkTo("fits", "comparison")}?${new URLSearchParams(ids.slice(0, MOST).map((id) => ["id", id]))}`;
}

interface Side {
  fit: Fit;
  model: ModelSummary | undefined;
  dataset: Dataset | undefined;
}

export function Comparison() {
  const [sides, setSides] = useState<Side[] | null>(null);
  const [trouble, setTrouble] = useState<string | null>(null);
  const ids = currentRoute().query.getAll("id").slice(0, MOST);
  useEffect(() => {
    document.title = "Fits compared · Fewview";
    sidesOf(ids).then(setSides, (error: Error) => setTrouble(error.message));
    // eslint-disable-next-line react-hooks/exhaustive-deps -- the identifiers, joined, are what it depends on
  }, [ids.join()]);
  if (sides === null) return <Waiting trouble={trouble} />;
  const settings = compared(sides.map(({ fit }) => fit.config));
  const differ = settings.filter((row) => row.differs);
  const alike = settings.filter((row) => !row.differs);
  return (
    <main class="lists">
      <header class="title">
        <h1>{count(sides.length, "fit")} compared</h1>
      </header>
      <section class="panel scrolled" tabIndex={0} aria-label="Figures and settings">
        <table class="comparison">
          <thead>
            <tr>
              <td />
              {sides.map(({ fit }) => (
                <th scope="col" key={fit.id}>
                  <a href={linkTo("fits", fit.id)}>{fit.name}</a> <span class="quiet">({fit.id.slice(-6)})</span>
                </th>
              ))}
            </tr>
          </thead>
          <tbody>
            {FIGURES.map(([name, figure]) => (
              <tr key={name}>
                <th scope="row">{name}</th>
                {sides.map((side) => (
                  <td key={side.fit.id}>{figure(side)}</td>
                ))}
              </tr>
            ))}
          </tbody>
          <Settings title={differ.length > 0 ? "Settings that differ" : "All settings are the same"} rows={differ} />
        </table>
      </section>
      <details class="panel">
        <summary>{count(alike.length, "setting")} that they share</summary>
        <table class="comparison">
          <tbody>
            {alike.map(({ name, values }) => (
              <tr key={name}>
                <th scope="row">{name}</th>
                <td>{values[0]}</td>
              </tr>
            ))}
          </tbody>
        </table>
      </details>
    </main>
  );
}

const FIGURES: [string, (side: Side) => preact.ComponentChildren][] = [
  ["Status", ({ fit }) => <Status fit={fit} />],
  ["Dataset", ({ dataset }) => dataset?.name ?? "deleted"],
  ["Frames", ({ fit }) => fit.frames.toLocaleString("en")],
  ["Reprojection error", ({ model }) => pixels(model?.reprojection_error)],
  ["Error against the truth", ({ model }) => number(model?.pa_mpjpe)],
  ["Took", ({ fit }) => (Number.isNaN(secondsOf(fit)) ? "–" : duration(secondsOf(fit)))],
  ["Warnings", ({ fit }) => fit.findings.filter(({ severity }) => severity === "warning").length],
  ["Version of Fewview", ({ fit }) => fit.version ?? "–"],
  ["Made", ({ fit }) => moment(fit.created_at)],
];

function Settings({ title, rows }: { title: string; rows: ReturnType<typeof compared> }) {
  return (
    <tbody>
      <tr>
        <th scope="colgroup" class="part" colSpan={1 + MOST}>
          {title}
        </th>
      </tr>
      {rows.map(({ name, values }) => (
        <tr key={name}>
          <th scope="row">{name}</th>
          {values.map((value, side) => (
            <td key={side}>{value}</td>
          ))}
        </tr>
      ))}
    </tbody>
  );
}

async function sidesOf(ids: string[]): Promise<Side[]> {
  const found = await listThese(listFits, ids);
  const fits = ids.flatMap((id) => found.filter((fit) => fit.id === id));
  const [models, datasets] = await Promise.all([
    listThese(
      listModels,
      fits.flatMap((fit) => (fit.model_id ? [fit.model_id] : [])),
    ),
    listThese(
      listDatasets,
      fits.map((fit) => fit.dataset_id),
    ),
  ]);
  return fits.map((fit) => ({
    fit,
    model: models.find(({ id }) => id === fit.model_id),
    dataset: datasets.find(({ id }) => id === fit.dataset_id),
  }));
}
