/** What single components show, without a browser: whole screens are tested by clicking (tests/page). */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import type { Dataset, Finding, Fit, Model } from "../../src/api/resources.ts";
import { unitOf } from "../../src/result/unit.ts";
import { ConfigForm } from "../../src/datasets/config_form.tsx";
import { Understood } from "../../src/datasets/understood.tsx";
import { Failure } from "../../src/fits/failure.tsx";
import { Progress } from "../../src/fits/progress.tsx";
import { Status } from "../../src/fits/status.tsx";
import { FindingList } from "../../src/parts/finding_list.tsx";
import { plusMinus } from "../../src/parts/format.ts";
import { Verdict } from "../../src/parts/verdict.tsx";
import { cellText, HeatKey } from "../../src/result/heat_map.tsx";
import { Legend } from "../../src/result/legend.tsx";
import { ShowContext, type Show } from "../../src/result/show.ts";
import { useHeat } from "../../src/result/use_heat.ts";
import { LEFT_OUT, UNSEEN } from "../../src/science/errors.ts";
import { happens, rendered } from "./rendered.ts";

const FINDING: Finding = {
  code: "noise_high",
  severity: "warning",
  views: [1],
  keypoints: [0],
  frames: [[3, 7]],
  evidence: { share: 0.25 },
  effect: "Structures are as noisy.",
  remedy: "Fit with `noise: 3`.",
};

test("findings are listed with where they are, warnings first, and lead there", async () => {
  const went: string[] = [];
  const info: Finding = {
    ...FINDING,
    code: "one_view",
    severity: "info",
    remedy: "",
    views: [],
    keypoints: [],
    frames: [],
  };
  const page = await rendered(
    <FindingList
      findings={[info, FINDING]}
      viewNames={["left", "right"]}
      keypointNames={["nose"]}
      onFrame={(frame) => went.push(`frame ${frame}`)}
      onKeypoint={(keypoint) => went.push(`keypoint ${keypoint}`)}
    />,
  );
  const [first, second] = page.getAllByRole("listitem");
  assert.match(first?.textContent ?? "", /Noise high.*right.*as noisy/);
  assert.match(second?.textContent ?? "", /One view/);
  assert.equal(page.getByText("noise: 3").tagName, "CODE");
  await happens(page.getByRole("button", { name: "frames 3–7" }), "click");
  await happens(page.getByRole("button", { name: "nose" }), "click");
  assert.deepEqual(went, ["frame 3", "keypoint 0"]);
});

test("a form for a fit hands on what was typed, and nothing that was not", async () => {
  const schema = readFileSync(new URL("../../../docs/openapi.json", import.meta.url), "utf8");
  globalThis.fetch = () => Promise.resolve(new Response(schema));
  let config: Record<string, unknown> = {};
  const dataset = { keypoints: 2, views: 2, skeleton: { keypoint_names: ["hip", "knee"] } } as unknown as Dataset;
  const page = await rendered(<ConfigForm dataset={dataset} onChange={(next) => (config = next)} />);
  assert.deepEqual(config, {});
  await happens(page.getByLabelText("From keypoint"), "change", "0");
  await happens(page.getByLabelText("To keypoint"), "change", "1");
  assert.deepEqual(config, {}); // a length is wanting
  await happens(page.getByLabelText(/^Length/), "input", "0.42");
  const known_length = { keypoints: [0, 1], length: 0.42 };
  assert.deepEqual(config, { known_length });
  await happens(page.getByLabelText("From camera"), "change", "1");
  await happens(page.getByLabelText("To camera"), "change", "0");
  await happens(page.getByLabelText(/^Distance/), "input", "2.5");
  assert.deepEqual(config, { known_length, known_distance: { views: [1, 0], length: 2.5 } });
  await happens(page.getByLabelText(/^Distance/), "input", "");
  assert.deepEqual(config, { known_length });
});

test("lengths have the unit of the known distance, where that was used", () => {
  const config = { known_distance: { views: [0, 1], length: 2.5 } };
  const unit = (...codes: string[]) =>
    unitOf({ config, findings: codes.map((code) => ({ code })) } as unknown as Model);
  assert.equal(unit("noise_high"), "unit of the known distance");
  assert.match(unit("known_distance_not_used"), /^no unit/);
});

const fit = (progress: Partial<NonNullable<Fit["progress"]>> | null): Fit =>
  ({ id: "fit_1", status: "running", cancel_requested: false, frames: 1200, findings: [], progress }) as unknown as Fit;

test("progress shows how far a fit is", async () => {
  const going = fit({ step: 300, steps: 1200, stage: "training", reprojection_error: 4.2, seconds_left: 90 });
  const page = await rendered(<Progress fit={going} history={[]} onFit={() => {}} />);
  assert.equal(page.getByRole<HTMLProgressElement>("progressbar").value, 0.25);
  page.getByText(/step 300 of 1,200 · about 90 s left|about 2 min left/);
  page.getByText("Training");
  const starting = await rendered(<Progress fit={fit(null)} history={[]} onFit={() => {}} />);
  starting.getByText("Starting");
  assert.equal(starting.queryByText(/left/), null);
});

const show = {
  take: { keypoints: 2, frames: 2, names: ["hip", "knee"], deviations: Float32Array.of(0.02, 0.04, NaN, 0.01) },
  unit: "metres",
  done: true,
  errors: { worst: Float32Array.of(1.5, UNSEEN, LEFT_OUT, 4), outliers: new Uint8Array(4) },
  errorsDone: true,
  selected: [],
} as unknown as Show;

/** The legend of the heat map, and each of its cells in words. */
function HeatInWords() {
  const heat = useHeat(show);
  return (
    <>
      <HeatKey heat={heat} />
      {[0, 1].flatMap((frame) =>
        [0, 1].map((keypoint) => <p key={2 * frame + keypoint}>{cellText(show, heat, { frame, keypoint })}</p>),
      )}
    </>
  );
}

test("a legend offers what views show; a cell of the heat map has its meaning in words", async () => {
  const chosen: string[] = [];
  const page = await rendered(
    <ShowContext.Provider value={show}>
      <Legend crop="subject" setCrop={(crop) => chosen.push(crop)} />
      <HeatInWords />
    </ShowContext.Provider>,
  );
  await happens(page.getByLabelText("views show"), "change", "image");
  assert.deepEqual(chosen, ["image"]);
  page.getByText(/0.*4 px.*outlier, left out.*not observed/s);
  const words = () => [...page.place.querySelectorAll("p")].map(({ textContent }) => textContent).join("; ");
  assert.match(words(), /hip, frame 0: 1.5 px; knee, frame 0: not observed.*hip, frame 1: outlier.*4 px/);
  await happens(page.getByLabelText("Colours show"), "change", "doubt");
  page.getByText(/0.*0.04 \(metres\).*not known/s);
  assert.match(words(), /knee, frame 0: may be off by 0.04 \(metres\); hip, frame 1: how far .* is not known/);
});

test("deviations decide how many digits are shown", () => {
  assert.equal(plusMinus(1.23456, 0.01234), "1.235\u00a0±\u00a00.012");
  assert.equal(plusMinus(152.3456, 2.1, "°"), "152.3°\u00a0±\u00a02.1°");
  assert.equal(plusMinus(0.5, 0.096), "0.500\u00a0±\u00a00.096");
  assert.equal(plusMinus(152.3456, 31), "152\u00a0±\u00a031");
  assert.equal(plusMinus(152.3456, NaN, "°"), "152°");
  assert.equal(plusMinus(NaN, 1), "–");
});

const judged = (verdict: Partial<NonNullable<Fit["verdict"]>> | null): Fit =>
  ({ status: verdict === null ? "failed" : "succeeded", findings: [], verdict }) as unknown as Fit;

test("a fit with serious findings is not simply succeeded, and no two sentences contradict each other", async () => {
  const serious = {
    level: "serious",
    code: "one_view",
    reliable: "Rely on what the view shows.",
    remedy: "Add a view.",
  };
  const doubted = await rendered(<Status fit={judged(serious as NonNullable<Fit["verdict"]>)} />);
  assert.equal(doubted.getByText("succeeded, with serious doubts").className, "status succeeded serious");
  const good = { level: "good", code: null, reliable: "Nothing was noticed.", remedy: "" } as const;
  (await rendered(<Status fit={judged(good)} />)).getByText("succeeded");
  const frames = await rendered(<Verdict verdict={good} framesDoubted />);
  assert.equal(frames.queryByText(/Nothing was noticed/), null);
  const failed = await rendered(<Failure fit={{ ...judged(null), error: { code: "timed_out", message: "Late." } }} />);
  assert.equal(failed.queryByText(/Nothing was noticed/), null);
});

const facts = (notes: string[], missing: number) =>
  ({ notes, missing_fraction: [0, missing], findings: [], view_names: null, skeleton: null }) as unknown as Dataset;

test("that nothing was noticed is good news only where nothing else gives cause for doubt", async () => {
  const calm = async (shown: Dataset) =>
    (await rendered(<Understood facts={shown} frame={null} />)).queryByText(/Nothing was noticed/) !== null;
  assert.equal(await calm(facts([], 0.2)), true);
  assert.equal(await calm(facts(["that all cameras show the same person is not sure"], 0.2)), false);
  assert.equal(await calm(facts([], 1)), false);
});
