/** Films a canvas while all frames are played once. */

import type { Player } from "./player.ts";

const FRAMES_PER_SECOND = 30;
const BITS_PER_SECOND = 8_000_000;

/** Returns what kind of film this browser writes: WebM, or MP4 where it knows no WebM. Chromium without
 * H.264 offers MP4 and leaves the file empty. */
export function filmKind(): { name: string; suffix: string; type: string } {
  return MediaRecorder.isTypeSupported("video/webm")
    ? { name: "WebM", suffix: ".webm", type: "video/webm" }
    : { name: "MP4", suffix: ".mp4", type: "video/mp4" };
}

/** Starts at the first frame, and gives the film once the last was shown or what it returns is
 * called. */
export function record(canvas: HTMLCanvasElement, player: Player, onFilm: (film: Blob) => void): () => void {
  const stream = canvas.captureStream(FRAMES_PER_SECOND);
  const recorder = new MediaRecorder(stream, { mimeType: filmKind().type, videoBitsPerSecond: BITS_PER_SECOND });
  const pieces: Blob[] = [];
  const looped = player.loop;
  player.setLoop(false);
  player.playing = false;
  player.show(0);
  recorder.ondataavailable = (event) => pieces.push(event.data);
  recorder.onstop = () => onFilm(new Blob(pieces, { type: recorder.mimeType }));
  recorder.start();
  player.toggle();
  const stop = () => {
    if (recorder.state === "inactive") return;
    stopListening();
    player.playing = false;
    player.setLoop(looped);
    recorder.stop();
    for (const track of stream.getTracks()) track.stop();
  };
  const stopListening = player.onChange(() => {
    if (!player.playing) setTimeout(stop, 100); // the last frame has yet to be drawn
  });
  return stop;
}
