/** Watches a stream that a program has opened: the frames that it sends, and what comes back. */

import { getCameras, getDataset, getModel, type LiftStream } from "../api/resources.ts";
import { numbered, type Capture } from "../data/capture.ts";
import { emptyTake, NOTHING, putDetected, putLifted } from "../data/take.ts";
import type { Frame } from "../data/placing.ts";
import { sidesOf } from "../science/sides.ts";
import { unitOf } from "../result/unit.ts";
import { connect, type Connection, type Trouble } from "./connection.ts";
import { noFigures, noteSecond, type Feed, type Figures, type Listener } from "./feed.ts";
import type { Running } from "./live_panels.tsx";
import { readWatched, viewsIn } from "./messages.ts";

const FRAMES = 600; // that are kept, some 20 s
const AHEAD = 30; // frames after the newest that are taken away: they are the oldest, not what comes next
const GONE = "The stream has ended.";

interface Heard {
  /** Called with every state of the stream, the first of which comes at once. */
  onState(stream: LiftStream): void;
  /** Called with the first frame, and with the first that has another number of views. */
  onRunning(running: Running): void;
  onEnd(reason: string): void;
  onTrouble(trouble: Trouble): void;
}

/** Watches a stream until that ends. Returns what stops it. */
export function watch(id: string, heard: Heard): () => void {
  const figures = noFigures();
  let stream: LiftStream | null = null;
  let views = 0;
  let onFrame: ((message: ArrayBuffer) => void) | null = null;
  const begin = async (state: LiftStream, count: number) => {
    onFrame = null;
    const { capture, posed, unit } = await describe(state, count);
    if (count !== views) return;
    heard.onRunning({
      ...{ unit, posed, frames: FRAMES, numbered: false },
      start(listener) {
        const { feed, put } = startFeed(capture, frameOf(state), figures, listener);
        onFrame = put;
        return feed;
      },
    });
  };
  const connection: Connection = connect(`lift/streams/${encodeURIComponent(id)}/watch`, {
    onMessage(message) {
      if (message instanceof ArrayBuffer) {
        const count = viewsIn(message);
        if (count === views) onFrame?.(message);
        else if (stream !== null) {
          views = count;
          begin(stream, count).catch((error: Error) => heard.onTrouble({ reason: error.message, forGood: true }));
        }
      } else if (message.type === "state") {
        stream = message as unknown as LiftStream;
        note(figures, stream);
        heard.onState(stream);
      } else if (message.type === "ended") {
        end(GONE);
      }
    },
    onTrouble(trouble) {
      figures.connected = false;
      if (trouble.forGood) end(stream === null ? trouble.reason : GONE);
      else heard.onTrouble(trouble);
    },
  });
  const end = (reason: string) => {
    figures.connected = false;
    connection.close();
    heard.onEnd(reason);
  };
  return () => connection.close();
}

function note(figures: Figures, state: LiftStream): void {
  figures.connected = true;
  figures.answered = state.answered;
  figures.dropped = state.dropped;
  figures.refused = state.refused;
  figures.notLifted = state.not_lifted;
  figures.perSecond = state.frames_per_second;
  noteSecond(figures, state.latency_ms ?? null, state.latency_p95_ms ?? null);
}

function frameOf({ frame, up }: LiftStream): Frame {
  if (frame === "canonical") return "view";
  return up === null || up === undefined ? "camera" : "level";
}

/** Returns what the frames of a stream show, as far as its model and that one's dataset know it. */
async function describe(stream: LiftStream, views: number) {
  const [model, cameras] = await Promise.all([getModel(stream.model), getCameras(stream.model)]);
  const dataset = model.dataset_id ? await getDataset(model.dataset_id).catch(() => null) : null;
  const order = stream.views ?? Array.from({ length: views }, (_, view) => view);
  const known = dataset !== null && (stream.views !== null || views === dataset.views);
  const names = model.skeleton?.keypoint_names ?? numbered("keypoint", stream.keypoints);
  const capture: Capture = {
    frames: FRAMES,
    views,
    keypoints: stream.keypoints,
    names,
    sides: sidesOf(names),
    edges: (model.skeleton?.edges ?? []) as [number, number][],
    viewNames: order.map((view) => (known ? dataset.view_names?.[view] : null) ?? `view ${view}`),
    imageSizes: order.map((view) => ((known ? dataset.image_sizes?.[view] : null) ?? null) as [number, number] | null),
    ...{ fps: null, times: null, hasTruth: false },
  };
  const posed = order.map((view) => cameras.views.some(({ index }) => index === view));
  return { capture, posed, unit: unitOf(model) };
}

/** Puts frames into a take in turn, the newest in the place of the oldest. */
function startFeed(capture: Capture, frame: Frame, figures: Figures, listener: Listener) {
  const take = emptyTake(capture, FRAMES, frame);
  const size = 3 * capture.keypoints;
  let next = 0;
  const put = (message: ArrayBuffer) => {
    const { pixels, lifted } = readWatched(message, capture.keypoints);
    putDetected(take, pixels, next);
    putLifted(take, lifted, next, 1);
    const gone = (next + AHEAD) % FRAMES;
    take.there[gone] = NOTHING;
    take.points.fill(NaN, gone * size, (gone + 1) * size);
    listener.onFrame(next);
    next = (next + 1) % FRAMES;
  };
  const feed: Feed = { take, figures, stop() {} };
  return { feed, put };
}
