/** A video or images of a view, read from the viewer's own disk: nothing is sent anywhere. */

export interface Film {
  /** Returns the picture of a frame, or null while it is not there yet. */
  at(frame: number, rate: number): CanvasImageSource | null;
  close(): void;
}

/** @param onPicture called when a picture that was asked for has come */
export function openFilm(files: File[], onPicture: () => void): Film {
  const video = files.find((file) => file.type.startsWith("video/"));
  return video !== undefined ? openVideo(video, onPicture) : openImages(files, onPicture);
}

function openVideo(file: File, onPicture: () => void): Film {
  const video = document.createElement("video");
  const url = URL.createObjectURL(file);
  video.muted = true;
  video.preload = "auto";
  video.src = url;
  video.addEventListener("seeked", onPicture);
  video.addEventListener("loadeddata", onPicture);
  return {
    at(frame, rate) {
      const wanted = (frame + 0.5) / rate; // the middle of a frame, where no rounding misses it
      if (!video.seeking && Math.abs(video.currentTime - wanted) > 0.25 / rate) {
        video.currentTime = Math.min(wanted, video.duration || wanted);
      }
      return video.readyState >= HTMLMediaElement.HAVE_CURRENT_DATA ? video : null;
    },
    close() {
      video.removeAttribute("src");
      URL.revokeObjectURL(url);
    },
  };
}

/** One image is shown under every frame; of several, in the order of their names, each has its own. */
function openImages(files: File[], onPicture: () => void): Film {
  const byName = new Intl.Collator("en", { numeric: true });
  const images = files.filter((file) => file.type.startsWith("image/")).sort((a, b) => byName.compare(a.name, b.name));
  let shown: ImageBitmap | null = null;
  let index = -1;
  return {
    at(frame) {
      const wanted = images.length === 1 ? 0 : Math.min(frame, images.length - 1);
      const image = images[wanted];
      if (wanted !== index && image !== undefined) {
        index = wanted;
        void createImageBitmap(image).then((bitmap) => {
          if (index !== wanted) return bitmap.close();
          shown?.close();
          shown = bitmap;
          onPicture();
        });
      }
      return shown;
    },
    close() {
      index = -1;
      shown?.close();
      shown = null;
    },
  };
}
