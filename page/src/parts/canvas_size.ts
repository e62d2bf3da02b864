/** Keeps a canvas as fine as the screen. To ask for its size at each drawing would have the browser
 * lay out the whole page, so it is heard when that changes. */

/** Calls a function after the canvas got another size; returns what ends that. */
export function keepSize(canvas: HTMLCanvasElement, onSize: () => void): () => void {
  const watcher = new ResizeObserver(([entry]) => {
    const ratio = pixelRatio();
    const { width, height } = entry.contentRect;
    canvas.width = Math.max(1, Math.round(width * ratio));
    canvas.height = Math.max(1, Math.round(height * ratio));
    onSize();
  });
  watcher.observe(canvas);
  return () => watcher.disconnect();
}

/** Pixels of a canvas in one of the page: two at most, beyond which nobody sees more. */
export function pixelRatio(): number {
  return Math.min(2, devicePixelRatio);
}
