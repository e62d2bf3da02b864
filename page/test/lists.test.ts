/** What is chosen from, or counted, is all that there is, and not the first page of it. */

import assert from "node:assert/strict";
import { globSync, readFileSync } from "node:fs";
import { join } from "node:path";
import { test } from "node:test";
import { listAll, type Lister } from "../src/api/lists.ts";

const SOURCES = join(import.meta.dirname, "../src");
// Lists of which the first page is meant: the newest, or whether there is any.
const FIRST_PAGES = ["fits/fits_screen.tsx"];

test("a list is fetched to its end, with its query on every page", async () => {
  const asked: unknown[] = [];
  const list: Lister<number> = async (query) => {
    asked.push([query?.from_model, query?.cursor]);
    const first = Number(query?.cursor ?? 0);
    return { items: [first, first + 1], next_cursor: first < 4 ? String(first + 2) : null };
  };
  assert.deepEqual(await listAll(list, { from_model: "mdl" }), [0, 1, 2, 3, 4, 5]);
  assert.deepEqual(asked, [
    ["mdl", undefined],
    ["mdl", "2"],
    ["mdl", "4"],
  ]);
});

test("no screen takes the first page of a list for all of it", () => {
  const files = globSync("**/*.{ts,tsx}", { cwd: SOURCES });
  const direct = files.filter((file) =>
    /\blist(Fits|Datasets|Models|Aliases)\(/.test(readFileSync(join(SOURCES, file), "utf8")),
  );
  assert.deepEqual(direct.sort(), FIRST_PAGES);
});
