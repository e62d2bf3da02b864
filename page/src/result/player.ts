/** Which frame is shown, and playing. Whoever draws listens; nothing here knows of screens. */

export interface Player {
  readonly frames: number;
  readonly rate: number; // frames per second at speed 1
  frame: number;
  playing: boolean;
  speed: number;
  loop: boolean;
  show(frame: number): void;
  step(by: number): void;
  toggle(): void;
  setSpeed(speed: number): void;
  setLoop(loop: boolean): void;
  advance(seconds: number): void;
  onChange(listener: () => void): () => void;
}

export function createPlayer(frames: number, rate: number, start: number): Player {
  const listeners = new Set<() => void>();
  let fraction = 0; // of a frame, that has been played beyond the one shown
  const changed = () => {
    for (const listener of listeners) listener();
  };
  const player: Player = {
    frames,
    rate,
    frame: Math.min(Math.max(0, start), frames - 1),
    playing: false,
    speed: 1,
    loop: true,
    show(frame) {
      fraction = 0;
      const next = Math.min(Math.max(0, Math.round(frame)), frames - 1);
      if (next === player.frame) return;
      player.frame = next;
      changed();
    },
    step(by) {
      player.playing = false;
      player.show(player.frame + by);
      changed();
    },
    toggle() {
      player.playing = !player.playing;
      if (player.playing && player.frame === frames - 1) player.frame = 0;
      changed();
    },
    setSpeed(speed) {
      player.speed = speed;
      changed();
    },
    setLoop(loop) {
      player.loop = loop;
      changed();
    },
    advance(seconds) {
      if (!player.playing) return;
      fraction += seconds * rate * player.speed;
      const whole = Math.floor(fraction);
      if (whole === 0) return;
      fraction -= whole;
      let next = player.frame + whole;
      if (next >= frames) {
        next = player.loop ? next % frames : frames - 1;
        player.playing = player.loop;
      }
      player.frame = next;
      changed();
    },
    onChange(listener) {
      listeners.add(listener);
      return () => listeners.delete(listener);
    },
  };
  return player;
}
