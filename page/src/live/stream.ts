/** A stream of frames to the service and of answers back, which goes on after a break. */

import { connect, type Message, type Trouble } from "./connection.ts";
import { frameMessage, readAnswer, type Answer } from "./messages.ts";

export interface Start {
  model: string;
  frame: "room" | "canonical";
  up?: "auto";
  refine?: "auto" | "off" | "full" | null;
  views?: readonly number[];
}

export interface Heard {
  onReady(): void;
  onAnswer(answer: Answer, milliseconds: number): void;
  onDropped(count: number): void;
  onRefused(): void;
  onTrouble(trouble: Trouble): void;
}

export interface Stream {
  /** Sends a frame and returns its number; null while there is no connection, or it takes no more. */
  send(pixels: Float32Array, views: number): number | null;
  close(): void;
}

/** Opens a stream of a model whose views have so many keypoints. */
export function openStream(start: Start, keypoints: number, heard: Heard): Stream {
  let ready = false;
  let sequence = 0;
  const sent = new Map<number, number>();
  const hear = (message: Message) => {
    if (message.type === "ready") {
      ready = true;
      heard.onReady();
    } else if (message.type === "dropped") {
      const dropped = message["sequences"] as number[];
      for (const each of dropped) sent.delete(each);
      heard.onDropped(dropped.length);
    } else if (typeof message["sequence"] === "number") {
      sent.delete(message["sequence"]);
      heard.onRefused();
    }
  };
  const connection = connect("lift/stream", {
    onOpen: (socket) => socket.send(JSON.stringify({ ...start, on_overload: "latest", continuity: true })),
    onMessage(message) {
      if (!(message instanceof ArrayBuffer)) return hear(message);
      const answer = readAnswer(message, keypoints);
      heard.onAnswer(answer, performance.now() - (sent.get(answer.sequence) ?? NaN));
      sent.delete(answer.sequence);
    },
    onTrouble(trouble) {
      ready = false;
      sent.clear();
      heard.onTrouble(trouble);
    },
  });
  return {
    send(pixels, views) {
      if (!ready || !connection.send(frameMessage(sequence, views, pixels))) return null;
      sent.set(sequence, performance.now());
      return sequence++;
    },
    close: () => connection.close(),
  };
}
