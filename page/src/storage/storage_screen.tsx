/** What is stored: how much of each kind, the largest of all, and what a key has left. */

import { useEffect, useState } from "preact/hooks";
import { getStorage, type Storage } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";
import { bytes, count, percent } from "../parts/format.ts";
import { linkTo } from "../route.ts";

const WORDS = {
  datasets: "Datasets",
  fits: "Fits and their reconstructions",
  lifts: "Lifts",
  models: "Models",
  aliases: "Aliases of models",
  webhooks: "Webhooks",
  deliveries: "Messages to webhooks, kept for a week",
  idempotency_keys: "Repeatable requests, kept for a day",
  audit: "Audit, kept for as long as the service is set to",
} as const;
const SINGULAR = { datasets: "dataset", fits: "fit", lifts: "lift", models: "model" } as const;

export function StorageScreen() {
  const [storage, setStorage] = useState<Storage | null>(null);
  const [trouble, setTrouble] = useState<string | null>(null);
  useEffect(() => {
    document.title = "Storage · Fewview";
    getStorage().then(setStorage, (error: Error) => setTrouble(error.message));
  }, []);
  return (
    <main>
      <header class="title">
        <h1>Storage</h1>
        {storage !== null && <span class="quiet">{bytes(storage.stored_bytes)} in all</span>}
      </header>
      <Alert>{trouble}</Alert>
      {storage !== null && (
        <>
          <Quota storage={storage} />
          <section class="panel">
            <h2>By kind</h2>
            <Kinds storage={storage} />
          </section>
          {storage.largest.length > 0 ? (
            <section class="panel" aria-label="The largest">
              <h2>The largest</h2>
              <Largest storage={storage} />
            </section>
          ) : (
            <section class="panel teach">
              <h2>Nothing is stored yet</h2>
              <p>
                Here you will see what takes the room, and what may go. Captures are small: a thousand frames of three
                views take a megabyte or two.
              </p>
              <a class="button primary" href={linkTo("datasets", "new")}>
                Store a capture
              </a>
            </section>
          )}
        </>
      )}
    </main>
  );
}

function Quota({ storage: { own_bytes: own, quota_bytes: quota } }: { storage: Storage }) {
  if (quota === null || quota === undefined) return null;
  const share = Math.min(1, own / Math.max(1, quota));
  return (
    <section class="panel progress-panel">
      <h2>
        Your key{" "}
        <span class="quiet">
          {bytes(own)} of the {bytes(quota)} that it may store
        </span>
      </h2>
      <progress max={1} value={share} aria-label="Part of the quota that is used" />
      {share > 0.9 && (
        <p class="warned">
          {percent(share)} are used, records included. Delete what is not needed, or ask who keeps the service for more.
        </p>
      )}
    </section>
  );
}

/** Datasets, fits, lifts and models always; what else counts where there is some. */
function isShown({ kind, count }: Storage["items"][number]) {
  return kind in SINGULAR || count > 0;
}

function Kinds({ storage }: { storage: Storage }) {
  const most = Math.max(1, ...storage.items.map((item) => item.stored_bytes));
  return (
    <table class="bars">
      <tbody>
        {storage.items.filter(isShown).map((item) => (
          <tr key={item.kind}>
            <th scope="row">{WORDS[item.kind]}</th>
            <td class="bar-cell" aria-hidden="true">
              <i style={{ width: `${(100 * item.stored_bytes) / most}%` }} />
            </td>
            <td>{bytes(item.stored_bytes)}</td>
            <td class="quiet">{count(item.count, "record")}</td>
          </tr>
        ))}
      </tbody>
    </table>
  );
}

function Largest({ storage }: { storage: Storage }) {
  return (
    <table>
      <thead>
        <tr>
          <th scope="col">name</th>
          <th scope="col">kind</th>
          <th scope="col">size</th>
        </tr>
      </thead>
      <tbody>
        {storage.largest.map(({ kind, id, name, stored_bytes: size }) => (
          <tr key={id}>
            <th scope="row">{kind === "lifts" ? name : <a href={linkTo(kind, id)}>{name}</a>}</th>
            <td>{SINGULAR[kind]}</td>
            <td class="size">{bytes(size)}</td>
          </tr>
        ))}
      </tbody>
    </table>
  );
}
