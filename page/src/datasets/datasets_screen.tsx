/** All datasets, the newest first. */

import { listDatasets } from "../api/lists.ts";
import type { Dataset } from "../api/resources.ts";
import { ListScreen, NewCapture, Warnings } from "../lists/list_screen.tsx";
import type { Column } from "../lists/table.tsx";
import { useList } from "../lists/use_list.ts";
import { moment, number } from "../parts/format.ts";

const COLUMNS: Column<Dataset>[] = [
  { title: "Frames", cell: ({ frames }) => frames.toLocaleString("en"), order: ({ frames }) => frames },
  { title: "Views", cell: ({ views }) => views, order: ({ views }) => views },
  { title: "Keypoints", cell: ({ keypoints }) => keypoints, order: ({ keypoints }) => keypoints },
  { title: "Frames/s", cell: ({ fps }) => number(fps), order: ({ fps }) => fps ?? NaN },
  {
    title: "Noticed",
    cell: (dataset) => (
      <>
        <Warnings findings={dataset.findings} /> {dataset.has_ground_truth && <span class="chip">ground truth</span>}
      </>
    ),
    order: ({ findings }) => findings.length,
  },
  {
    title: "Stored",
    cell: ({ created_at: at }) => moment(at),
    order: ({ created_at: at }) => Date.parse(at),
  },
];

export function DatasetsScreen() {
  return (
    <ListScreen
      kind="datasets"
      title="Datasets"
      list={useList(listDatasets)}
      columns={COLUMNS}
      beside={<NewCapture />}
      teach={<Teach />}
    />
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
