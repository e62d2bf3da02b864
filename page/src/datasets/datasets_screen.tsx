/** All datasets, the newest first. */

import { listDatasets, type Dataset } from "../api/resources.ts";
import { captured } from "../fits/fits_screen.tsx";
import { moment } from "../parts/format.ts";
import { ListScreen, NewCapture, Warnings } from "../parts/list_screen.tsx";
import { useList } from "../parts/use_list.ts";
import { linkTo } from "../route.ts";

export function DatasetsScreen() {
  const row = (dataset: Dataset) => <DatasetRow dataset={dataset} />;
  return (
    <ListScreen title="Datasets" list={useList(listDatasets)} beside={<NewCapture />} teach={<Teach />} row={row} />
  );
}

function DatasetRow({ dataset }: { dataset: Dataset }) {
  return (
    <a class="panel row" href={linkTo("datasets", dataset.id)}>
      <strong>{dataset.name}</strong>
      <span class="quiet">{captured(dataset)}</span>
      <span class="facts">
        <Warnings findings={dataset.findings} />
        {dataset.has_ground_truth && <span class="chip">ground truth</span>}
        <span class="quiet">{moment(dataset.created_at)}</span>
      </span>
    </a>
  );
}

function Teach() {
  return (
    <section class="panel teach">
      <h2>A dataset is what your cameras saw</h2>
      <p>
        Of each camera the keypoints that a detector found, frame by frame: a file of DeepLabCut, SLEAP, OpenPose and
        others for each view, or one array. No calibration, no 3D.
      </p>
      <NewCapture>Store the first one</NewCapture>
    </section>
  );
}
