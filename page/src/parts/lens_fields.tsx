/** What people know of a lens without a calibration: a row for each view, or one for all of them. */

import { useState } from "preact/hooks";
import type { components } from "../api/openapi.d.ts";

export type Lens = components["schemas"]["Lens"];

type Way = "equivalent" | "horizontal" | "vertical" | "diagonal" | "focal" | `same_as:${number}`;

const WAYS: readonly (readonly [Way, string, string])[] = [
  ["equivalent", "focal length, as of 35 mm film", "mm"],
  ["horizontal", "field of view across", "°"],
  ["vertical", "field of view, top to bottom", "°"],
  ["diagonal", "field of view, corner to corner", "°"],
  ["focal", "focal length", "px"],
];

interface Row {
  way: Way | "";
  number: string;
  slack: string; // per cent
}

const EMPTY: Row = { way: "", number: "", slack: "5" };

interface Props {
  names: readonly string[]; // of the views
  before?: readonly (Lens | null)[] | null;
  onChange: (lenses: (Lens | null)[] | null) => void; // null: nothing is known
}

export function LensFields({ names, before = null, onChange }: Props) {
  const [rows, setRows] = useState<Row[]>(() => rowsOf(before));
  const each = rows.length > 1;
  const change = (next: Row[]) => {
    setRows(next);
    const lenses = next.map(lensOf);
    onChange(lenses.some((lens) => lens !== null) ? lenses : null);
  };
  const edit = (at: number, part: Partial<Row>) => {
    change(rows.map((row, index) => (index === at ? { ...row, ...part } : row)));
  };
  return (
    <div class="lenses">
      {rows.map((row, index) => {
        const called = each ? (names[index] ?? `${index}`) : "all views";
        return (
          <div class="lens" key={index}>
            <span>{called}</span>
            <select
              aria-label={`What is known of the lens of ${called}`}
              value={row.way}
              onChange={(event) => edit(index, { way: event.currentTarget.value as Way | "" })}
            >
              <option value="">not known</option>
              {WAYS.map(([way, words]) => (
                <option key={way} value={way}>
                  {words}
                </option>
              ))}
              {each &&
                names.map(
                  (name, view) =>
                    view !== index && (
                      <option key={view} value={`same_as:${view}`}>
                        same lens and zoom as {name}
                      </option>
                    ),
                )}
            </select>
            {row.way !== "" && !row.way.startsWith("same_as") && (
              <>
                <input
                  aria-label={`Lens of ${called}`}
                  type="number"
                  min={0}
                  step="any"
                  value={row.number}
                  onInput={(event) => edit(index, { number: event.currentTarget.value })}
                />
                {WAYS.find(([way]) => way === row.way)?.[2]} ±
                <input
                  aria-label={`How unsure the lens of ${called} is, per cent`}
                  type="number"
                  min={0.1}
                  max={100}
                  step="any"
                  value={row.slack}
                  onInput={(event) => edit(index, { slack: event.currentTarget.value })}
                />
                %
              </>
            )}
          </div>
        );
      })}
      <label>
        <input
          type="checkbox"
          checked={each}
          onChange={(event) =>
            change(event.currentTarget.checked ? names.map(() => rows[0] ?? EMPTY) : rows.slice(0, 1))
          }
        />{" "}
        each view has its own
      </label>
    </div>
  );
}

function lensOf({ way, number, slack }: Row): Lens | null {
  if (way.startsWith("same_as:")) return { same_as: Number(way.slice("same_as:".length)) };
  const value = Number(number);
  if (way === "" || !(value > 0)) return null;
  const sd = Number(slack) > 0 ? { sd: Number(slack) / 100 } : {};
  if (way === "equivalent" || way === "focal") return { [way]: value, ...sd };
  return { field_of_view: value, axis: way as "horizontal" | "vertical" | "diagonal", ...sd };
}

function rowsOf(lenses: readonly (Lens | null)[] | null): Row[] {
  if (lenses === null || lenses.length === 0) return [EMPTY];
  return lenses.map((lens) => {
    if (lens === null) return EMPTY;
    const slack = `${Number((100 * (lens.sd ?? 0.05)).toPrecision(4))}`;
    if (typeof lens.same_as === "number") return { way: `same_as:${lens.same_as}`, number: "", slack };
    if (typeof lens.equivalent === "number") return { way: "equivalent", number: `${lens.equivalent}`, slack };
    if (typeof lens.focal === "number") return { way: "focal", number: `${lens.focal}`, slack };
    return { way: lens.axis ?? "horizontal", number: `${lens.field_of_view ?? ""}`, slack };
  });
}
