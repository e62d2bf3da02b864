/** A screen that lists what is stored of a kind: a heading, rows, and older ones on demand. */

import type { ComponentChildren } from "preact";
import { useEffect } from "preact/hooks";
import { linkTo } from "../route.ts";
import { Alert } from "./alert.tsx";
import { count } from "./format.ts";
import { Icon } from "./icons.tsx";
import type { List } from "./use_list.ts";

interface Props<T> {
  title: string;
  list: List<T>;
  beside: ComponentChildren; // of the heading
  teach: ComponentChildren; // shown where there is none
  row: (item: T) => ComponentChildren;
  isGoing?: (item: T) => boolean;
  above?: ComponentChildren;
  children?: ComponentChildren; // below
}

export function ListScreen<T extends { id: string }>(props: Props<T>) {
  const { title, list, beside, teach, row, isGoing, above, children } = props;
  useEffect(() => {
    document.title = `${title} · Fewview`;
  }, []);
  return (
    <main>
      <header class="title">
        <h1>{title}</h1>
        {beside}
      </header>
      <Alert>{list.trouble}</Alert>
      {above}
      {list.items?.length === 0 && teach}
      <ul class="list">
        {list.items?.map((item) => (
          <li key={item.id} class={isGoing?.(item) ? "going" : ""}>
            {row(item)}
          </li>
        ))}
      </ul>
      {list.more !== null && <button onClick={list.more}>Older {title.toLowerCase()}</button>}
      {children}
    </main>
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
