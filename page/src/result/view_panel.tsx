/** One view: its keypoints, the structure projected over them and, if one likes, the film below. */

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { nearest } from "../data/take.ts";
import { keepSize } from "../parts/canvas_size.ts";
import { number } from "../parts/format.ts";
import { Icon } from "../parts/icons.tsx";
import { useHandle } from "./correcting/use_handle.ts";
import { partsOf, type Crop, type Part } from "./crop.ts";
import { openFilm, type Film } from "./film.ts";
import { pickOn } from "./scene/picking.ts";
import { useShown } from "./show.ts";
import { createViewDrawing } from "./view_drawing.ts";

export function ViewPanel({ view, crop }: { view: number; crop: Crop }) {
  const { take, player, loop, theme, selected, select, through, lookThrough, posed, done, joined, editing } =
    useShown();
  const canvas = useRef<HTMLCanvasElement>(null);
  const error = useRef<HTMLSpanElement>(null);
  const edges = joined?.edges ?? take.edges;
  const drawing = useMemo(() => createViewDrawing(take, view, edges), [take, view, edges]);
  // eslint-disable-next-line react-hooks/exhaustive-deps -- the part follows what is detected, which comes by and by
  const partOf = useMemo(() => partsOf(take, view, crop), [take, view, crop, done]);
  const { held, on, onKeyDown } = useHandle(canvas, drawing, view);
  const part = useRef<Part | null>(null); // that is shown: it stays while a keypoint is held
  const [film, setFilm] = useState<Film | null>(null);
  const [offset, setOffset] = useState(0); // of the film, in frames of the capture

  useEffect(() => {
    const context = canvas.current?.getContext("2d") ?? null;
    if (context === null) return undefined;
    return loop.add(() => {
      const picture = player.frame + offset < 0 ? null : (film?.at(player.frame + offset, player.rate) ?? null);
      const frame = nearest(take, player.frame);
      if (!held.current || part.current === null) part.current = partOf(frame);
      const isCorrected = (keypoint: number) => editing?.at({ frame, view, keypoint }) !== undefined;
      drawing.draw(context, frame, theme, part.current, selected, picture, isCorrected);
      const pixels = take.viewErrors[player.frame * take.views + view];
      if (error.current !== null) error.current.textContent = `${number(pixels)} px`;
    });
  }, [drawing, partOf, theme, selected, loop, player, take, view, film, offset, editing, held]);

  useEffect(() => {
    if (canvas.current === null) return undefined;
    return keepSize(canvas.current, () => loop.wake());
  }, [loop]);

  useEffect(() => {
    if (canvas.current === null) return undefined;
    return pickOn(canvas.current, { names: take.names, places: drawing.places, onPick: select });
  }, [take, drawing, select]);

  useEffect(() => () => film?.close(), [film]);

  const open = (files: FileList | null) => {
    if (files !== null && files.length > 0) setFilm(openFilm([...files], () => loop.wake()));
  };
  const name = take.viewNames[view];
  return (
    <figure
      class={`panel view${through === view ? " chosen" : ""}`}
      onDragOver={(event) => event.preventDefault()}
      onDrop={(event) => {
        event.preventDefault();
        open(event.dataTransfer?.files ?? null);
      }}
    >
      <figcaption>
        {posed[view] ? (
          <button class="plain" onClick={() => lookThrough(through === view ? null : view)} title="Look through">
            {name}
          </button>
        ) : (
          <strong>{name}</strong>
        )}
        <span class="quiet" ref={error} title="Mean reprojection error of this frame" />
        <label class="button small" title="A video or images of this view. They stay in this browser.">
          <Icon name="picture" />
          <span class="unseen">Video or images of {name}, which stay in this browser</span>
          <input
            type="file"
            accept="video/*,image/*"
            multiple
            onChange={({ currentTarget }) => {
              open(currentTarget.files);
              currentTarget.value = ""; // so that the same can be chosen again
            }}
          />
        </label>
      </figcaption>
      {film !== null && (
        <div class="film">
          <label>
            Offset in frames
            <input
              type="number"
              step={1}
              value={offset}
              title="Frame 0 of the capture shows this frame of the video"
              onInput={(event) => setOffset(Math.round(Number(event.currentTarget.value)))}
            />
          </label>
          <button
            onClick={() => {
              setFilm(null);
              setOffset(0);
            }}
          >
            Remove <span class="unseen">the video or images of {name}</span>
          </button>
        </div>
      )}
      <canvas
        ref={canvas}
        role={on ? "application" : "img"}
        tabIndex={on ? 0 : -1}
        class={on ? "editable" : ""}
        aria-label={
          on
            ? `${name}: arrows move the selected keypoint, Delete removes it`
            : `${name}: detected keypoints, and the structure projected`
        }
        onFocus={() => editing?.setView(view)}
        onKeyDown={onKeyDown}
      />
    </figure>
  );
}
