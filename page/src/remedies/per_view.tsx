/** A table with a row for each view, in which numbers of it are typed. */

import { useSubject, viewNames } from "./subject.ts";

interface Column {
  name: string; // as in "Width of cam1"
  unit: string;
  step: number | "any";
  hint?: string; // in a field that is empty
}

interface Props {
  columns: readonly Column[];
  texts: readonly (readonly string[])[]; // as they were typed, a row for each view
  onText: (view: number, column: number, text: string) => void;
}

export function PerView({ columns, texts, onText }: Props) {
  const { dataset } = useSubject();
  return (
    <table class="per-view">
      <thead>
        <tr>
          <th>View</th>
          {columns.map(({ name, unit }) => (
            <th key={name}>
              {name}, {unit}
            </th>
          ))}
        </tr>
      </thead>
      <tbody>
        {viewNames(dataset).map((called, view) => (
          <tr key={view}>
            <td>{called}</td>
            {columns.map(({ name, step, hint }, column) => (
              <td key={name}>
                <input
                  aria-label={`${name} of ${called}`}
                  type="number"
                  min={1}
                  step={step}
                  placeholder={hint}
                  value={texts[view]?.[column] ?? ""}
                  onInput={(event) => onText(view, column, event.currentTarget.value)}
                />
              </td>
            ))}
          </tr>
        ))}
      </tbody>
    </table>
  );
}
