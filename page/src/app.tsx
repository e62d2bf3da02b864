/** The page: which screen is shown, and the key that the service may ask for. */

import { lazy, Suspense } from "preact/compat";
import { useEffect, useState } from "preact/hooks";
import { keepKey, keyIn, onKeyNeeded, takeKeyFromAddress } from "./api/key.ts";
import { DatasetsScreen } from "./datasets/datasets_screen.tsx";
import { DatasetScreen } from "./datasets/dataset_screen.tsx";
import { NewScreen } from "./datasets/new_screen.tsx";
import { Comparison } from "./fits/comparison.tsx";
import { FitScreen } from "./fits/fit_screen.tsx";
import { FitsScreen } from "./fits/fits_screen.tsx";
import { ModelScreen } from "./models/model_screen.tsx";
import { ModelsScreen } from "./models/models_screen.tsx";
import { currentRoute, linkTo } from "./route.ts";
import { keepPlaces } from "./scrolling.ts";
import { StorageScreen } from "./storage/storage_screen.tsx";

const LiveScreen = lazy(() => import("./live/live_screen.tsx"));
const WatchScreen = lazy(() => import("./live/watch_screen.tsx"));
const SCREENS: [string, string][] = [
  ["datasets", "Datasets"],
  ["models", "Models"],
  ["live", "Live"],
  ["storage", "Storage"],
];

export function App() {
  const [path, setPath] = useState(() => currentRoute().path);
  const [keyNeeded, setKeyNeeded] = useState(false);
  const [tries, setTries] = useState(0);
  useEffect(() => {
    const go = () => {
      if (takeKeyFromAddress()) {
        setTries((before) => before + 1);
        setKeyNeeded(false);
      }
      setPath(currentRoute().path);
    };
    window.addEventListener("hashchange", go);
    return () => window.removeEventListener("hashchange", go);
  }, []);
  useEffect(keepPlaces, []);
  useEffect(() => onKeyNeeded(() => setKeyNeeded(true)), []);
  return (
    <>
      <nav class="bar" aria-label="Fewview">
        <a class="brand" href={linkTo()}>
          <svg viewBox="0 0 24 24" aria-hidden="true">
            <path d="M3 7l7 4v8l-7-4zM21 7l-7 4v8l7-4zM12 3l5 3-5 3-5-3z" />
          </svg>
          Fewview
        </a>
        <a href={linkTo()} aria-current={path.length === 0 || path[0] === "fits" ? "page" : undefined}>
          Fits
        </a>
        {SCREENS.map(([name, title]) => (
          <a key={name} href={linkTo(name)} aria-current={path[0] === name ? "page" : undefined}>
            {title}
          </a>
        ))}
        <a class="docs" href="docs">
          API
        </a>
      </nav>
      {keyNeeded ? (
        <KeyForm
          tried={tries > 0}
          onKey={(key) => {
            keepKey(key);
            setTries(tries + 1);
            setKeyNeeded(false);
          }}
        />
      ) : (
        <Screen key={`${tries} ${path.join("/")}`} path={path} />
      )}
    </>
  );
}

function Screen({ path }: { path: string[] }) {
  const [kind, id] = path;
  if (kind === "fits" && id === "comparison") return <Comparison />;
  if (kind === "fits" && id !== undefined) return <FitScreen id={id} />;
  if (kind === "datasets" && id === "new") return <NewScreen />;
  if (kind === "datasets" && id !== undefined) return <DatasetScreen id={id} />;
  if (kind === "datasets") return <DatasetsScreen />;
  if (kind === "models" && id !== undefined) return <ModelScreen id={id} />;
  if (kind === "models") return <ModelsScreen />;
  if (kind === "storage") return <StorageScreen />;
  if (kind === undefined || kind === "fits") return <FitsScreen />;
  if (kind === "live") {
    return (
      <Suspense fallback={<div class="waiting-page quiet">Loading …</div>}>
        {id === undefined ? <LiveScreen /> : <WatchScreen id={id} />}
      </Suspense>
    );
  }
  return (
    <main>
      <div class="panel empty">
        <h2>There is nothing here</h2>
        <a class="button" href={linkTo()}>
          All fits
        </a>
      </div>
    </main>
  );
}

function KeyForm({ tried, onKey }: { tried: boolean; onKey: (key: string) => void }) {
  const [key, setKey] = useState("");
  return (
    <main>
      <form
        class="panel key-form"
        onSubmit={(event) => {
          event.preventDefault();
          if (keyIn(key) !== "") onKey(keyIn(key));
        }}
      >
        <h1>This service needs a key</h1>
        <p>
          {tried
            ? "That key was refused: it is unknown, expired, revoked, or of an earlier start of the service. "
            : ""}
          Is the service on this computer, and yours? Then <code>fewview open</code> opens this page with its key, as
          does the address that <code>fewview serve</code> printed.
        </p>
        <p>
          Elsewhere who keeps the service makes a key with <code>fewview key create</code>. It stays in this tab, and is
          forgotten when you close it.
        </p>
        <label>
          Key
          <input
            type="password"
            autocomplete="off"
            value={key}
            onInput={(event) => setKey(event.currentTarget.value)}
            autofocus
          />
        </label>
        <button class="primary" disabled={key.trim() === ""}>
          Go on
        </button>
      </form>
    </main>
  );
}
