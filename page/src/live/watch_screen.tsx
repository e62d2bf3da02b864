/** A stream that a program has opened, watched as it goes. */

import { useEffect, useState } from "preact/hooks";
import { getModel, type LiftStream } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";
import { moment } from "../parts/format.ts";
import { linkTo } from "../route.ts";
import type { Trouble } from "./connection.ts";
import { LivePanels, type Running } from "./live_panels.tsx";
import { OpenStreams } from "./open_streams.tsx";
import { watch } from "./watch.ts";

export default function WatchScreen({ id }: { id: string }) {
  const [stream, setStream] = useState<LiftStream | null>(null);
  const [name, setName] = useState("");
  const [running, setRunning] = useState<Running | null>(null);
  const [trouble, setTrouble] = useState<Trouble | null>(null);
  const [ended, setEnded] = useState<string | null>(null);
  useEffect(() => {
    document.title = "Live · Fewview";
    return watch(id, {
      onState(state) {
        setStream((before) => before ?? state);
        setTrouble(null);
      },
      onRunning: setRunning,
      onEnd: setEnded,
      onTrouble: setTrouble,
    });
  }, [id]);
  useEffect(() => {
    if (stream === null) return;
    getModel(stream.model).then(
      (model) => setName(model.name),
      () => setName(stream.model), // it was deleted since
    );
  }, [stream]);
  return (
    <main class="wide">
      <header class="title">
        <h1>Live{name && `: ${name}`}</h1>
        {stream !== null && (
          <span class="quiet">
            A stream that {stream.key_id} opened {moment(stream.since)}
          </span>
        )}
        <a href={linkTo("live")}>All streams</a>
      </header>
      <Alert>{ended}</Alert>
      {ended !== null && <OpenStreams />}
      {ended === null && <Alert>{trouble && `${trouble.reason} ${trouble.forGood ? "" : "Trying again."}`}</Alert>}
      {running === null && ended === null && <p class="quiet">Waiting for a frame of the stream …</p>}
      {running !== null && <LivePanels running={running} />}
    </main>
  );
}
