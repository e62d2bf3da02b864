/** The control of every remedy can be used: it asks for something, and does something with it. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import type { Dataset, Fit } from "../../src/api/resources.ts";
import { Controls } from "../../src/remedies/provider.tsx";
import { REMEDIES, type RemedyField } from "../../src/remedies/registry.ts";
import { subjectOf, SubjectContext, type Lifting, type Subject } from "../../src/remedies/subject.ts";
import { happens, rendered } from "./rendered.ts";

const FIELDS = Object.keys(REMEDIES) as RemedyField[];
const dataset = {
  ...{ id: "ds_1", name: "walk", views: 2, keypoints: 4, view_names: ["left", "right"] },
  skeleton: { keypoint_names: ["head", "hip", "knee", "ankle"], edges: [] },
} as unknown as Dataset;
const fit = { id: "fit_1", dataset_id: "ds_1", name: "walk", tags: [], config: {} } as unknown as Fit;

function subject(more: Partial<Subject>): Subject {
  return { ...subjectOf(dataset, () => {}), ...more };
}

async function shown(field: RemedyField, about: Subject) {
  const page = await rendered(
    <SubjectContext.Provider value={about}>
      <Controls fields={[field]} />
    </SubjectContext.Provider>,
  );
  const fold = page.place.querySelector("details");
  if (fold !== null) {
    fold.open = true;
    await happens(fold, "toggle");
  }
  return page;
}

test("each remedy that the service names has a control with something to choose", async () => {
  const { components } = JSON.parse(readFileSync(new URL("../../../docs/openapi.json", import.meta.url), "utf8"));
  assert.deepEqual([...FIELDS].sort(), [...components.schemas.RemedyField.enum].sort());
  globalThis.fetch = () => Promise.resolve(new Response('{"items": []}'));
  const lifting: Lifting = { frame: "room", refine: null, views: [0, 1] };
  for (const field of FIELDS) {
    const { place } = await shown(field, subject({ fit, model: "mdl_1", lifting }));
    const control = REMEDIES[field].direct ? "button" : ".remedy-control :is(select, input)";
    assert.ok(place.querySelector(control), field);
  }
});

test("what cannot be taken in a place has no control there", async () => {
  const there: RemedyField[] = [];
  for (const field of FIELDS) {
    if ((await shown(field, subject({}))).place.querySelector("details") !== null) there.push(field);
  }
  assert.deepEqual(there, ["fps", "image_sizes", "mirror"]);
});

test("frames are asked for as was chosen", async () => {
  const asked: Lifting[] = [];
  const live = subject({
    lifting: { frame: "room", refine: null, views: [0, 1] },
    onLifting: (change) => asked.push(change),
  });
  const chosen = async (field: RemedyField, ...choices: [string, string][]) => {
    const page = await shown(field, live);
    for (const [label, value] of choices) await happens(page.getByLabelText(label), "change", value);
    await happens(page.getByRole("button", { name: "Show it so" }), "click");
  };
  await chosen("frame", ["Frame of reference", "canonical"]);
  await chosen("refine", ["Refinement", "full"]);
  await chosen("views", ["Camera of left", "1"]); // two views of one camera: nothing is asked
  await chosen("views", ["Camera of left", "1"], ["Camera of right", "0"]);
  assert.deepEqual(asked, [{ frame: "canonical" }, { refine: "full" }, { views: [1, 0] }]);
});

test("a fit is made again with lenses that are alike", async () => {
  let sent: unknown;
  globalThis.fetch = (_, init) => {
    sent = JSON.parse(init?.body as string);
    return Promise.resolve(new Response('{"id": "fit_2"}'));
  };
  const page = await shown("cameras_alike", subject({ fit }));
  await happens(page.getByLabelText("Lenses"), "change", "true");
  await happens(page.getByRole("button", { name: "Fit again with it" }), "click");
  assert.deepEqual(sent, { dataset_id: "ds_1", name: "walk", tags: [], config: { cameras_alike: true } });
});

test("what was wrong with a view's pixels is undone, or left, with one button", async () => {
  const sent: unknown[] = [];
  globalThis.fetch = (_, init) => {
    sent.push((JSON.parse(init?.body as string) as Fit).config);
    return Promise.resolve(new Response('{"id": "fit_2"}'));
  };
  const asked = { ...fit, config: { mend: "auto", steps: 100 } } as Fit;
  for (const [about, name] of [
    [fit, "Undo it, and fit again"],
    [asked, "Fit again with the pixels as they are"],
  ] as const) {
    const page = await shown("mend", subject({ fit: about }));
    await happens(page.getByRole("button", { name }), "click");
  }
  assert.deepEqual(sent, [{ mend: "auto" }, { mend: "off", steps: 100 }]);
});

test("files of mirrored views are chosen again, with the option", async () => {
  const page = await shown("mirror", subject({}));
  await happens(page.getByLabelText("right"), "change");
  const link = page.getByRole<HTMLAnchorElement>("link", { name: "Choose the files" });
  assert.equal(link.getAttribute("href"), "#/datasets/new?mirror=right");
});
