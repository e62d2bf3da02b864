// A capture loop: node stream.ts URL MODEL VIEWS KEYPOINTS < keypoints.f32  (node 22.18 on)
//
// URL is ws://127.0.0.1:8000/lift/stream. Lifts frame by frame as cameras take them, and prints of
// each its number and its points, x y z after x y z. In place of a file, `frames` are what your
// detector says: VIEWS x KEYPOINTS x (x, y), float32, pixels, NaN: not observed.

import { readFileSync } from "node:fs";

const [url, model, views, keypoints] = process.argv.slice(2);
const size = 8 * Number(views) * Number(keypoints);
const frames = readFileSync(0);
const socket = new WebSocket(url);
socket.binaryType = "arraybuffer";
let sequence = 0;

function sendFrame(): void {
  if ((sequence + 1) * size > frames.length) {
    socket.close();
    return;
  }
  const message = new Uint8Array(8 + size);
  const header = new DataView(message.buffer);
  header.setUint8(0, 1); // a frame, without confidence
  header.setUint16(2, Number(views), true);
  header.setUint32(4, sequence, true);
  message.set(frames.subarray(sequence * size, (sequence + 1) * size), 8);
  socket.send(message);
  sequence += 1;
}

socket.onopen = () => socket.send(JSON.stringify({ model }));
socket.onmessage = ({ data }: MessageEvent<string | ArrayBuffer>) => {
  if (typeof data === "string") {
    const said = JSON.parse(data);
    if (said.type !== "ready") throw new Error(data);
  } else {
    const answer = new DataView(data);
    const points = Array.from({ length: 3 * Number(keypoints) }, (_, i) =>
      answer.getFloat32(8 + 4 * i, true),
    );
    console.log(answer.getUint32(4, true), ...points);
  }
  sendFrame();
};
socket.onerror = () => {
  console.error(`${url} cannot be reached`);
  process.exitCode = 1;
};
