/** All datasets, the newest first. */

import { useEffect } from "preact/hooks";
import { listDatasets } from "../api/resources.ts";
import { captured } from "../fits/fits_screen.tsx";
import { count, moment } from "../parts/format.ts";
import { Icon } from "../parts/icons.tsx";
import { useList } from "../parts/use_list.ts";
import { linkTo } from "../route.ts";

export function DatasetsScreen() {
  const { items, trouble, more } = useList(listDatasets);
  useEffect(() => {
    document.title = "Datasets · Fewview";
  }, []);
  return (
    <main>
      <header class="title">
        <h1>Datasets</h1>
        <a class="button primary" href={linkTo("datasets", "new")}>
          <Icon name="plus" /> New capture
        </a>
      </header>
      {trouble !== null && (
        <p class="trouble" role="alert">
          {trouble}
        </p>
      )}
      {items?.length === 0 && (
        <section class="panel teach">
          <h2>A dataset is what your cameras saw</h2>
          <p>
            Of each camera the keypoints that a detector found, frame by frame: a file of DeepLabCut, SLEAP, OpenPose and
            others for each view, or one array. No calibration, no 3D.
          </p>
          <a class="button primary" href={linkTo("datasets", "new")}>
            <Icon name="plus" /> Store the first one
          </a>
        </section>
      )}
      <ul class="list">
        {items?.map((dataset) => {
          const warnings = dataset.findings.filter(({ severity }) => severity === "warning").length;
          return (
            <li key={dataset.id}>
              <a class="panel row" href={linkTo("datasets", dataset.id)}>
                <strong>{dataset.name}</strong>
                <span class="quiet">{captured(dataset)}</span>
                <span class="facts">
                  {warnings > 0 && (
                    <span class="warned">
                      <Icon name="warning" /> {count(warnings, "warning")}
                    </span>
                  )}
                  {dataset.has_ground_truth && <span class="chip">ground truth</span>}
                  <span class="quiet">{moment(dataset.created_at)}</span>
                </span>
              </a>
            </li>
          );
        })}
      </ul>
      {more !== null && <button onClick={more}>Older datasets</button>}
    </main>
  );
}
