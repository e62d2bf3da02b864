/** Sends the frames of a stored capture as its cameras took them, again and again. */

import type { CaptureFile } from "../data/capture.ts";
import { emptyTake, putDetected, putLifted, type OpenTake } from "../data/take.ts";
import type { Frame } from "../data/placing.ts";
import { quantile } from "../science/worst.ts";
import { noFigures, noteSecond, type Feed, type Listener } from "./feed.ts";
import { openStream, type Start, type Stream } from "./stream.ts";

const PART = 240; // frames that are fetched at a time
const TICK_MS = 4;
const LATE_MS = 500; // beyond which frames are skipped, as a camera's would be lost
const MOST_SENT = 240; // frames that may yet be answered

/** How frames are asked for that are shown in a frame of reference. */
export const START: Record<Frame, Pick<Start, "frame" | "up">> = {
  level: { frame: "room", up: "auto" },
  camera: { frame: "room" },
  view: { frame: "canonical" },
};

/** @param frame of reference in which they are shown
 * @param rate frames per second */
export function startReplay(file: CaptureFile, start: Start, frame: Frame, rate: number, listener: Listener): Feed {
  const { capture } = file;
  const take = emptyTake(capture, capture.frames, frame);
  const figures = { ...noFigures(), sent: 0 };
  let latencies: number[] = []; // milliseconds, of this second
  const frames = new Map<number, number>(); // by sequence
  const stream = openStream(start, capture.keypoints, {
    onReady() {
      figures.connected = true;
      listener.onReady();
    },
    onAnswer({ sequence, lifted }, milliseconds) {
      const shown = frames.get(sequence);
      frames.delete(sequence);
      figures.answered++;
      latencies.push(milliseconds);
      if (lifted === null) figures.notLifted++;
      if (lifted === null || shown === undefined) return;
      putLifted(take, lifted, shown, 1);
      listener.onFrame(shown);
    },
    onDropped(many) {
      figures.dropped += many;
    },
    onRefused() {
      figures.refused++;
    },
    onTrouble(trouble) {
      figures.connected = false;
      frames.clear();
      listener.onTrouble(trouble);
    },
  });
  const stop = sendInTime(file, take, stream, rate, (sequence, sentFrame) => {
    frames.set(sequence, sentFrame);
    if (frames.size > MOST_SENT) frames.delete(frames.keys().next().value ?? 0); // of dropped ones
    figures.sent++;
  });
  const clock = setInterval(() => {
    const some = latencies.length > 0;
    figures.perSecond = latencies.length;
    noteSecond(figures, some ? quantile(latencies, 0.5) : null, some ? quantile(latencies, 0.95) : null);
    latencies = [];
  }, 1000);
  return {
    take,
    figures,
    stop() {
      clearInterval(clock);
      stop();
      stream.close();
    },
  };
}

/** Sends frames at their pace, of parts that are fetched before they are due. Returns what ends it. */
function sendInTime(
  file: CaptureFile,
  take: OpenTake,
  stream: Stream,
  rate: number,
  onSent: (sequence: number, frame: number) => void,
): () => void {
  const parts = new Map<number, "asked" | "there">();
  const size = 2 * take.views * take.keypoints;
  const fetchPart = (part: number) => {
    if (parts.has(part)) return;
    parts.set(part, "asked");
    file.detected(part * PART, Math.min(take.frames, (part + 1) * PART)).then(
      (detected) => {
        putDetected(take, detected, part * PART);
        parts.set(part, "there");
      },
      () => parts.delete(part), // it is asked for again
    );
  };
  let frame = 0;
  let due = performance.now();
  const tick = () => {
    const now = performance.now();
    if (now - due > LATE_MS) {
      const lost = Math.floor(((now - due) * rate) / 1000);
      if (parts.get(Math.floor(frame / PART)) === "there") frame = (frame + lost) % take.frames;
      due += (1000 * lost) / rate;
    }
    for (; due <= now; due += 1000 / rate) {
      const part = Math.floor(frame / PART);
      fetchPart(part);
      fetchPart(Math.floor(((frame + PART) % take.frames) / PART));
      if (parts.get(part) !== "there") return;
      const sequence = stream.send(take.detected.subarray(frame * size, (frame + 1) * size), take.views);
      if (sequence !== null) onSent(sequence, frame);
      frame = (frame + 1) % take.frames;
    }
  };
  const timer = setInterval(tick, TICK_MS);
  return () => clearInterval(timer);
}
