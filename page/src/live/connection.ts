/** A WebSocket of the service that is opened again after a break. */

import { addressOf } from "../api/http.ts";
import { currentKey } from "../api/key.ts";

export interface Trouble {
  reason: string;
  forGood: boolean;
}

interface Heard {
  onOpen?(socket: WebSocket): void;
  /** Called with what came: bytes, or an object that was JSON. */
  onMessage(message: ArrayBuffer | Message): void;
  /** Called when the connection broke. */
  onTrouble(trouble: Trouble): void;
}

export type Message = { type: string } & Record<string, unknown>;

export interface Connection {
  /** Sends a message; returns false where it cannot go just now. */
  send(message: string | ArrayBuffer): boolean;
  close(): void;
}

const AGAIN_MS = 1500; // after a connection broke
const FOR_GOOD = 4000; // from this close code on the service says why it will not
const PASSING = [4500, 4503]; // of these those that pass
const MOST_WAITING = 4_000_000; // bytes that the browser has yet to send

export function connect(path: string, heard: Heard): Connection {
  let socket: WebSocket;
  let closed = false;
  let reason = "";
  const open = () => {
    const key = currentKey();
    socket = new WebSocket(addressOf(path).replace(/^http/, "ws"), key === null ? [] : ["fewview", `bearer.${key}`]);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => heard.onOpen?.(socket);
    socket.onmessage = ({ data }: MessageEvent<string | ArrayBuffer>) => {
      if (closed) return;
      const message = typeof data === "string" ? (JSON.parse(data) as Message) : data;
      if (!(message instanceof ArrayBuffer) && message.type === "error") reason = String(message["detail"]);
      heard.onMessage(message);
    };
    socket.onclose = ({ code }) => {
      if (closed) return;
      const forGood = code >= FOR_GOOD && !PASSING.includes(code);
      heard.onTrouble({ reason: reason || "The connection broke.", forGood });
      reason = "";
      if (!forGood) setTimeout(() => closed || open(), AGAIN_MS);
    };
  };
  open();
  return {
    send(message) {
      if (socket.readyState !== WebSocket.OPEN || socket.bufferedAmount > MOST_WAITING) return false;
      socket.send(message);
      return true;
    },
    close() {
      closed = true;
      socket.close();
    },
  };
}
