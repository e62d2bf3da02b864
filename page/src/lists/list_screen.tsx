/** A screen that lists what is stored of a kind: searched, sorted, chosen from. */

import type { ComponentChildren } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import type { Kind } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";
import { count } from "../parts/format.ts";
import { Icon } from "../parts/icons.tsx";
import { linkTo } from "../route.ts";
import { Chosen } from "./chosen.tsx";
import { Table, type Column, type Listed } from "./table.tsx";
import type { List } from "./use_list.ts";

const TYPING_MS = 250; // after the last letter, before it is searched

interface Props<T> {
  kind: Kind;
  title: string;
  list: List<T>;
  columns: Column<T>[];
  beside: ComponentChildren; // of the heading
  teach: ComponentChildren; // shown where there is none
  statuses?: readonly string[];
  above?: ComponentChildren;
  under?: (item: T) => ComponentChildren; // the name of a row
  /** What can be done with those chosen, besides what can be done with any. */
  choices?: (chosen: T[]) => ComponentChildren;
  children?: ComponentChildren; // below
}

export function ListScreen<T extends Listed>(props: Props<T>) {
  const { kind, title, list, columns, beside, teach, statuses, above, under, choices, children } = props;
  const [ids, setIds] = useState(new Set<string>());
  const { items, wanted, want } = list;
  useEffect(() => {
    document.title = `${title} · Fewview`;
  }, [title]);
  const chosen = (items ?? []).filter(({ id }) => ids.has(id));
  const anything = wanted.search !== "" || wanted.tag !== "" || wanted.status !== "";
  return (
    <main class="lists">
      <header class="title">
        <h1>{title}</h1>
        {beside}
      </header>
      <Alert>{list.trouble}</Alert>
      {above}
      {items?.length === 0 && !anything && teach}
      {(anything || (items?.length ?? 0) > 0) && (
        <Search list={list} title={title} statuses={statuses ?? []} columns={columns} />
      )}
      {items?.length === 0 && anything && <p class="quiet">None of your {title.toLowerCase()} is like that.</p>}
      {chosen.length > 0 && (
        <Chosen
          kind={kind}
          items={chosen}
          onTagged={list.put}
          onDeleted={(gone) => {
            list.drop(gone);
            setIds(new Set([...ids].filter((id) => !gone.has(id))));
          }}
          onNone={() => setIds(new Set())}
          beside={choices?.(chosen)}
        />
      )}
      {items !== null && items.length > 0 && (
        <Table
          title={title}
          items={items}
          columns={columns}
          sort={wanted.sort}
          onSort={(sort) => want({ sort })}
          onTag={(tag) => want({ tag })}
          chosen={ids}
          onChoose={setIds}
          link={({ id }) => linkTo(kind, id)}
          under={under}
        />
      )}
      {list.more !== null && (
        <button class="more" onClick={list.more}>
          Older {title.toLowerCase()}
        </button>
      )}
      {children}
    </main>
  );
}

interface SearchProps<T> {
  list: List<T>;
  title: string;
  statuses: readonly string[];
  columns: Column<T>[];
}

function Search<T>({ list: { items, more, wanted, want }, title, statuses, columns }: SearchProps<T>) {
  const [typed, setTyped] = useState(wanted.search);
  const timer = useRef<ReturnType<typeof setTimeout>>(undefined);
  useEffect(() => () => clearTimeout(timer.current), []);
  const type = (text: string) => {
    setTyped(text);
    clearTimeout(timer.current);
    timer.current = setTimeout(() => want({ search: text }), TYPING_MS);
  };
  const shown = items === null ? "" : `${count(items.length, title.slice(0, -1).toLowerCase())}${more ? " shown" : ""}`;
  return (
    <search class="filters">
      <input
        type="search"
        aria-label={`Search ${title.toLowerCase()}`}
        placeholder="Search names and tags"
        maxLength={200}
        value={typed}
        onInput={(event) => type(event.currentTarget.value)}
      />
      {statuses.length > 0 && (
        <select
          aria-label="Status"
          value={wanted.status}
          onChange={(event) => want({ status: event.currentTarget.value })}
        >
          <option value="">any status</option>
          {statuses.map((status) => (
            <option key={status}>{status}</option>
          ))}
        </select>
      )}
      <select
        class="sorting"
        aria-label="Sort by"
        value={wanted.sort}
        onChange={(event) => want({ sort: event.currentTarget.value })}
      >
        <option value="">the newest first</option>
        <option value="Name">by name</option>
        {columns
          .filter(({ order }) => order !== undefined)
          .map(({ title: by }) => (
            <option key={by} value={`-${by}`}>
              by {by.toLowerCase()}, the largest first
            </option>
          ))}
      </select>
      {wanted.tag !== "" && (
        <button class="chip" aria-label={`No longer only those tagged ${wanted.tag}`} onClick={() => want({ tag: "" })}>
          {wanted.tag} <Icon name="close" />
        </button>
      )}
      <span class="quiet" role="status">
        {shown}
      </span>
    </search>
  );
}

/** The button that leads to a new capture. */
export function NewCapture({ children = "New capture" }: { children?: ComponentChildren }) {
  return (
    <a class="button primary" href={linkTo("datasets", "new")}>
      <Icon name="plus" /> {children}
    </a>
  );
}

/** How many warnings there are among findings, if any. */
export function Warnings({ findings }: { findings: { severity: string }[] }) {
  const many = findings.filter(({ severity }) => severity === "warning").length;
  if (many === 0) return null;
  return (
    <span class="warned">
      <Icon name="warning" /> {count(many, "warning")}
    </span>
  );
}
