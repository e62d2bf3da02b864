/** Frames and answers of a stream as bytes: docs/streaming.md says how they are laid out. */

import type { Lifted } from "../data/take.ts";

const FRAME = 1; // kinds of messages
const ANSWER = 2;
const WATCHED = 3;
const HEADER = 8; // bytes
const VIEW = 27; // numbers of four bytes
const LIFTED = 1; // flags of an answer
const FINDINGS = 2; // how far the bits of findings are shifted in the flags

/** Returns the message of a frame.
 *
 * @param pixels (K, P, 2), NaN where not observed */
export function frameMessage(sequence: number, views: number, pixels: Float32Array): ArrayBuffer {
  const message = new ArrayBuffer(HEADER + 4 * pixels.length);
  const header = new DataView(message);
  header.setUint8(0, FRAME);
  header.setUint16(2, views, true);
  header.setUint32(4, sequence, true);
  new Float32Array(message, HEADER).set(pixels);
  return message;
}

export interface Answer {
  sequence: number;
  lifted: Lifted | null; // one frame; null if it could not be lifted
}

/** @param keypoints of a view */
export function readAnswer(message: ArrayBuffer, keypoints: number): Answer {
  const { flags, sequence, lifted } = read(message, ANSWER, keypoints);
  return { sequence, lifted: flags & LIFTED ? lifted : null };
}

/** How many views a frame has that is watched. */
export function viewsIn(message: ArrayBuffer): number {
  return new DataView(message).getUint16(2, true);
}

export interface WatchedFrame {
  pixels: Float32Array; // (K, P, 2) as they were sent
  lifted: Lifted; // one frame; NaN where it could not be lifted
}

/** @param keypoints of a view */
export function readWatched(message: ArrayBuffer, keypoints: number): WatchedFrame {
  const { lifted } = read(message, WATCHED, keypoints);
  return { pixels: new Float32Array(message, message.byteLength - pixelBytes(message, keypoints)), lifted };
}

/** How many bytes at its end are the keypoints of a frame that is watched. */
function pixelBytes(message: ArrayBuffer, keypoints: number): number {
  return 8 * viewsIn(message) * keypoints;
}

function read(message: ArrayBuffer, kind: number, keypoints: number) {
  const header = new DataView(message);
  if (header.getUint8(0) !== kind) throw new Error("The service sent a message of an unknown kind.");
  const flags = header.getUint8(1);
  const views = header.getUint16(2, true);
  const sequence = header.getUint32(4, true);
  const start = HEADER + 12 * keypoints;
  const outliers = start + 4 * VIEW * views + 4 * Math.ceil(keypoints / 4);
  const deviations = outliers + 4 * views * keypoints;
  const end = message.byteLength - (kind === WATCHED ? pixelBytes(message, keypoints) : 0);
  const lifted: Lifted = {
    frames: 1,
    views,
    keypoints,
    points: new Float32Array(message.slice(HEADER, start)),
    ...viewsOf(message, start, views),
    outliers: new Float32Array(message, outliers, views * keypoints),
    bits: [flags >> FINDINGS],
    // A stream whose `uncertainty` is off has none.
    deviations: end > deviations ? new Float32Array(message, deviations, keypoints) : undefined,
  };
  return { flags, sequence, lifted };
}

function viewsOf(message: ArrayBuffer, start: number, views: number) {
  const integers = new Int32Array(message, start, VIEW * views);
  const numbers = new Float32Array(message, start, VIEW * views);
  const column = (from: number, count: number) =>
    Float32Array.from(
      { length: views * count },
      (_, at) => numbers[VIEW * Math.floor(at / count) + from + (at % count)]!,
    );
  return {
    cameras: {
      models: Int8Array.from({ length: views }, (_, view) => integers[VIEW * view]!),
      rotations: column(1, 9),
      scales: column(10, 1),
      translations: column(11, 3),
      focals: column(14, 2),
      principalPoints: column(16, 2),
      distortions: column(18, 8),
    },
    errors: column(26, 1),
  };
}
