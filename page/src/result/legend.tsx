/** What colours and strokes mean, and what the views show. */

import type { Crop } from "./crop.ts";

export function Legend({ crop, setCrop }: { crop: Crop; setCrop: (crop: Crop) => void }) {
  return (
    <div class="legend quiet">
      <span>
        <i class="dot left" /> left
      </span>
      <span>
        <i class="dot right" /> right
      </span>
      <span>
        <i class="dot middle" /> neither
      </span>
      <span>
        <i class="stroke projected" /> structure, projected
      </span>
      <span>
        <i class="stroke bad" /> its distance from what was detected
      </span>
      <span>
        <i class="cross">×</i> outlier
      </span>
      <span>
        <i class="box">□</i> corrected
      </span>
      <label class="check last">
        views show
        <select value={crop} onChange={(event) => setCrop(event.currentTarget.value as Crop)}>
          <option value="subject">the subject</option>
          <option value="path">wherever it goes</option>
          <option value="image">whole images</option>
        </select>
      </label>
    </div>
  );
}
