/** A stream of frames to the service and of answers back, which goes on after a break. */

import { addressOf } from "../api/http.ts";
import { currentKey } from "../api/key.ts";
import { frameMessage, readAnswer, type Answer } from "./messages.ts";

export interface Start {
  model: string;
  frame: "room" | "canonical";
  up?: "auto";
}

export interface Heard {
  onReady(): void;
  onAnswer(answer: Answer, milliseconds: number): void;
  onDropped(count: number): void;
  /** Called when the connection broke; what follows says whether it is tried again. */
  onTrouble(trouble: Trouble): void;
}

export interface Trouble {
  reason: string;
  forGood: boolean;
  noRoom: boolean; // the model has no such frame of reference
}

export interface Stream {
  /** Sends a frame and returns its number; null while there is no connection, or it takes no more. */
  send(pixels: Float32Array, views: number): number | null;
  close(): void;
}

const AGAIN_MS = 1500; // after a connection broke
const FOR_GOOD = 4000; // from this close code on the service says why it will not
const PASSING = [4500, 4503]; // of these those that pass
const NO_ROOM = 4409;
const MOST_WAITING = 4_000_000; // bytes that the browser has yet to send

/** Opens a stream of a model whose views have so many keypoints. */
export function openStream(start: Start, keypoints: number, heard: Heard): Stream {
  let socket: WebSocket;
  let ready = false;
  let closed = false;
  let sequence = 0;
  let reason = "";
  const sent = new Map<number, number>();

  function connect(): void {
    const key = currentKey();
    const url = addressOf("lift/stream").replace(/^http/, "ws");
    socket = new WebSocket(url, key === null ? [] : ["fewview", `bearer.${key}`]);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => socket.send(JSON.stringify({ ...start, on_overload: "latest", continuity: true }));
    socket.onmessage = ({ data }) => {
      if (typeof data === "string") return hear(JSON.parse(data) as Message);
      const answer = readAnswer(data as ArrayBuffer, keypoints);
      heard.onAnswer(answer, performance.now() - (sent.get(answer.sequence) ?? NaN));
      sent.delete(answer.sequence);
    };
    socket.onclose = ({ code }) => {
      ready = false;
      sent.clear();
      if (closed) return;
      const forGood = code >= FOR_GOOD && !PASSING.includes(code);
      heard.onTrouble({ reason: reason || "The connection broke.", forGood, noRoom: code === NO_ROOM });
      reason = "";
      if (!forGood) setTimeout(() => closed || connect(), AGAIN_MS);
    };
  }
  function hear(message: Message): void {
    if (message.type === "ready") {
      ready = true;
      heard.onReady();
    } else if (message.type === "dropped") {
      for (const each of message.sequences) sent.delete(each);
      heard.onDropped(message.sequences.length);
    } else {
      reason = message.detail;
      if (message.sequence !== undefined && message.sequence !== null) sent.delete(message.sequence);
    }
  }
  connect();
  return {
    send(pixels, views) {
      if (!ready || socket.bufferedAmount > MOST_WAITING) return null;
      sent.set(sequence, performance.now());
      socket.send(frameMessage(sequence, views, pixels));
      return sequence++;
    },
    close() {
      closed = true;
      socket.close();
    },
  };
}

type Message =
  | { type: "ready" }
  | { type: "dropped"; sequences: number[] }
  | { type: "error"; detail: string; sequence?: number | null };
