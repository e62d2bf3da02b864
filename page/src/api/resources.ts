/** The service's resources that the page shows, in the types of its OpenAPI document. */

import { ask, askBytes, askJson, askTagged, sendJson, sendTagged } from "./http.ts";
import type { components } from "./openapi.d.ts";

type Schemas = components["schemas"];
export type Dataset = Schemas["Dataset"];
export type DatasetPreview = Schemas["DatasetPreview"];
export type CalibrationPreview = Schemas["CalibrationPreview"];
export type Fit = Schemas["Fit"];
export type FitSchedule = Schemas["FitSchedule"];
export type Model = Schemas["Model"];
export type ModelSummary = Schemas["ModelSummary"];
export type ModelCameras = Schemas["ModelCameras"];
export type FitCameras = Schemas["FitCameras"];
export type DatasetCorrections = Schemas["DatasetCorrections"];
export type CorrectionsState = Schemas["CorrectionsState"];
export type Finding = Schemas["FindingForm"];
export type Alias = Schemas["Alias"];
export type KnownSkeleton = Schemas["KnownSkeleton"];
export type Storage = Schemas["Storage"];
export type WaitingJobs = Schemas["WaitingJobs"];
export type LiftStream = Schemas["LiftStream"];
/** What has a page of its own, and can be renamed and deleted. */
export type Kind = "datasets" | "fits" | "models";

export const getFit = (id: string) => askJson<Fit>(`fits/${encodeURIComponent(id)}`);
export const getSchedule = (id: string) => askJson<FitSchedule>(`fits/${encodeURIComponent(id)}/schedule`);
export const getDataset = (id: string) => askJson<Dataset>(`datasets/${encodeURIComponent(id)}`);
export const readDataset = async (id: string) => {
  const { found, tag } = await askTagged<Dataset>(`datasets/${encodeURIComponent(id)}`);
  return { dataset: found, tag };
};
export const changeDataset = (id: string, change: object, tag: string | null = null) =>
  sendJson<Dataset>(`datasets/${encodeURIComponent(id)}`, change, "PATCH", tag);
export const listSkeletons = () => askJson<{ items: KnownSkeleton[] }>("skeletons");
export const getModel = (id: string) => askJson<Model>(`models/${encodeURIComponent(id)}`);
export const getCameras = (id: string) => askJson<ModelCameras>(`models/${encodeURIComponent(id)}/cameras`);
/** Of a fit that goes on, too, once geometry has found them. */
export const getFitCameras = (id: string) => askJson<FitCameras>(`fits/${encodeURIComponent(id)}/cameras`);
/** @param corrected whether corrections are applied, or keypoints as they were detected */
export const capturePath = (id: string, corrected: boolean) =>
  `datasets/${encodeURIComponent(id)}/capture${corrected ? "" : "?corrected=false"}`;
export const readCorrections = (id: string) =>
  askTagged<DatasetCorrections>(`datasets/${encodeURIComponent(id)}/corrections`);
export const correctKeypoints = (id: string, change: object, tag: string | null) =>
  sendTagged<CorrectionsState>(`datasets/${encodeURIComponent(id)}/corrections`, change, "PATCH", tag);
export const getReconstruction = (fit: string, query: string) =>
  askBytes(`fits/${encodeURIComponent(fit)}/reconstruction?format=safetensors${query}`);
/** Returns the cameras of a calibration file for the views of a dataset. */
export const previewCalibration = (dataset: string, files: File[]) => {
  const form = new FormData();
  for (const file of files) form.append("files", file, file.name);
  const path = `previews/calibrations?dataset_id=${encodeURIComponent(dataset)}`;
  return askJson<CalibrationPreview>(path, { method: "POST", body: form });
};
export const createFit = (body: object) => sendJson<Fit>("fits", body);
export const cancelFit = (id: string) => askJson<Fit>(`fits/${encodeURIComponent(id)}/cancel`, { method: "POST" });
export const setAlias = (alias: string, model: string) =>
  sendJson<Alias>(`models/${encodeURIComponent(alias)}`, { model_id: model }, "PUT");
export const deleteAlias = (alias: string) => remove("models", alias);
export const getStorage = () => askJson<Storage>("storage");
/** Changes the labels of something stored, and returns those that it has then. */
export const relabel = (kind: Kind, id: string, labels: { tags: string[] }) =>
  sendJson<{ tags: string[] }>(`${kind}/${encodeURIComponent(id)}`, labels, "PATCH");
export const rename = (kind: Kind, id: string, name: string) =>
  sendJson<{ name: string }>(`${kind}/${encodeURIComponent(id)}`, { name }, "PATCH");
export const remove = (kind: Kind | "lifts", id: string) =>
  ask(`${kind}/${encodeURIComponent(id)}`, { method: "DELETE" });
