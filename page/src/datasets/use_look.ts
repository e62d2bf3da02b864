/** Has the service look at files, again whenever they or what is known of them changes. */

import { useEffect, useState } from "preact/hooks";
import { Refusal } from "../api/http.ts";
import type { DatasetPreview } from "../api/resources.ts";
import { sidesOf } from "../science/sides.ts";
import type { Drawn } from "./preview.ts";
import type { Placed } from "./dropping.ts";
import { lookAt, type Description } from "./upload.ts";

export type Look =
  | { state: "none" }
  | { state: "sending"; share: number }
  | { state: "refused"; reason: string; fields: string[] } // of the form that are at fault
  | { state: "seen"; preview: DatasetPreview; drawn: Drawn };

const PAUSE_MS = 500; // after the last key that was typed

export function useLook(files: Placed[], description: Description): Look {
  const [look, setLook] = useState<Look>({ state: "none" });
  const { fps, width, height, person, views, reading } = description;
  const cameras = views?.map(({ source }) => source).join(",") ?? "";
  useEffect(() => {
    if (files.length === 0) {
      setLook({ state: "none" });
      return undefined;
    }
    const stop = new AbortController();
    const put = (next: Look) => {
      if (!stop.signal.aborted) setLook(next);
    };
    const begin = () => {
      put({ state: "sending", share: 0 });
      const onProgress = (share: number) => put({ state: "sending", share });
      lookAt(files, description, { onProgress, onBreak: () => {}, signal: stop.signal }).then(
        (preview) => put({ state: "seen", preview, drawn: drawnOf(preview) }),
        (error: Error) => {
          const fields = error instanceof Refusal ? error.fields : [];
          put({ state: "refused", reason: error.message, fields });
        },
      );
    };
    const timer = setTimeout(begin, PAUSE_MS);
    return () => {
      clearTimeout(timer);
      stop.abort();
    };
    // eslint-disable-next-line react-hooks/exhaustive-deps -- the name changes nothing of what is understood
  }, [files, fps, width, height, person, cameras, reading]);
  return look;
}

function drawnOf({ frame_keypoints: views, skeleton, keypoints }: DatasetPreview): Drawn {
  const names = skeleton?.keypoint_names ?? [];
  return {
    views: views.map((points) => Float32Array.from(points.flatMap((point) => point ?? [NaN, NaN]))),
    edges: (skeleton?.edges ?? []) as [number, number][],
    sides: names.length === keypoints ? sidesOf(names) : [],
  };
}
