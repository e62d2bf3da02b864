/** Rows of what is stored, under columns that they can be sorted by; in the hand each row is a card. */

import type { ComponentChildren } from "preact";
import { Icon } from "../parts/icons.tsx";

export interface Column<T> {
  title: string;
  cell: (item: T) => ComponentChildren;
  /** What rows are sorted by. */
  order?: (item: T) => number | string;
}

export interface Listed {
  id: string;
  name: string;
  tags: string[];
}

interface Props<T> {
  title: string;
  items: T[];
  columns: Column<T>[];
  sort: string; // as in `Wanted`
  onSort: (sort: string) => void;
  onTag: (tag: string) => void;
  chosen: Set<string>;
  onChoose: (chosen: Set<string>) => void;
  link: (item: T) => string;
  under?: ((item: T) => ComponentChildren) | undefined; // the name
}

export function Table<T extends Listed>(props: Props<T>) {
  const { title, items, columns, sort, onSort, onTag, chosen, onChoose, link, under } = props;
  const all = items.length > 0 && items.every(({ id }) => chosen.has(id));
  const turn = (id: string) => {
    const next = new Set(chosen);
    if (!next.delete(id)) next.add(id);
    onChoose(next);
  };
  const byName = { title: "Name", order: ({ name }: T) => name };
  return (
    <table class="listing panel" aria-label={title}>
      <thead>
        <tr>
          <td>
            <input
              type="checkbox"
              aria-label="Choose all that are shown"
              checked={all}
              onChange={() => onChoose(new Set(all ? [] : items.map(({ id }) => id)))}
            />
          </td>
          {[byName, ...columns].map((column) => (
            <Heading key={column.title} column={column} sort={sort} onSort={onSort} />
          ))}
        </tr>
      </thead>
      <tbody>
        {sorted(items, [byName, ...columns], sort).map((item) => (
          <tr key={item.id}>
            <td>
              <input
                type="checkbox"
                aria-label={`Choose ${item.name}`}
                checked={chosen.has(item.id)}
                onChange={() => turn(item.id)}
              />
            </td>
            <th scope="row">
              <a href={link(item)} title={item.name}>
                {item.name}
              </a>
              {item.tags.map((tag) => (
                <button class="chip" key={tag} title="Show those with this tag" onClick={() => onTag(tag)}>
                  {tag}
                </button>
              ))}
              {under?.(item)}
            </th>
            {columns.map((column) => (
              <td key={column.title} data-title={column.title}>
                {column.cell(item)}
              </td>
            ))}
          </tr>
        ))}
      </tbody>
    </table>
  );
}

interface HeadingProps<T> {
  column: Pick<Column<T>, "title" | "order">;
  sort: string;
  onSort: (sort: string) => void;
}

/** A heading that sorts by its column: numbers first from the largest, at the next click the other way. */
function Heading<T>({ column: { title, order }, sort, onSort }: HeadingProps<T>) {
  if (order === undefined) return <th scope="col">{title}</th>;
  const down = `-${title}`;
  const state = sort === title ? "ascending" : sort === down ? "descending" : "none";
  const next = { none: down, descending: title, ascending: "" }[state];
  return (
    <th scope="col" aria-sort={state}>
      <button class="plain" onClick={() => onSort(next)}>
        {title}
        {state !== "none" && <Icon name={state === "ascending" ? "up" : "down"} />}
      </button>
    </th>
  );
}

const BY_NAME = new Intl.Collator("en", { numeric: true });

/** Returns items in the order of a column; those without a number come last. */
export function sorted<T>(items: T[], columns: Pick<Column<T>, "title" | "order">[], sort: string): T[] {
  const order = columns.find(({ title }) => title === sort.replace(/^-/, ""))?.order;
  if (order === undefined) return items;
  const sign = sort.startsWith("-") ? -1 : 1;
  const compare = (a: number | string, b: number | string): number => {
    if (typeof a === "string" || typeof b === "string") return sign * BY_NAME.compare(String(a), String(b));
    if (Number.isNaN(a) || Number.isNaN(b)) return Number(Number.isNaN(a)) - Number(Number.isNaN(b));
    return sign * (a - b);
  };
  return items
    .map((item) => ({ item, key: order(item) }))
    .sort((a, b) => compare(a.key, b.key))
    .map(({ item }) => item);
}
