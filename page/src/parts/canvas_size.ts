/** Keeps a canvas as fine as the screen. To ask for its size at each drawing would have the browser
 * lay out the whole page, so it is heard when that changes. */

/** Calls a function after the canvas got another size; returns what ends that. */
export function keepSize(canvas: HTMLCanvasElement, onSize: () => void): () => void {
  const watcher = new ResizeObserver((entries) => {
    const size = entries.at(-1)?.contentRect;
    if (size !== undefined && resize(canvas, size.width, size.height)) onSize();
  });
  watcher.observe(canvas);
  return () => watcher.disconnect();
}

/** Gives a canvas a size in pixels of the page; returns whether it had another. */
export function resize(canvas: HTMLCanvasElement, width: number, height: number): boolean {
  const pixels = (side: number) => Math.max(1, Math.round(side * pixelRatio()));
  const [wide, high] = [pixels(width), pixels(height)];
  if (canvas.width === wide && canvas.height === high) return false;
  canvas.width = wide;
  canvas.height = high;
  return true;
}

/** Pixels of a canvas in one of the page: two at most, beyond which nobody sees more. */
export function pixelRatio(): number {
  return Math.min(2, devicePixelRatio);
}
