/** The cameras that a fit is given: those that came with the files, those of a file, or none. */

import { useEffect, useState } from "preact/hooks";
import { previewCalibration, type CalibrationPreview, type Dataset } from "../api/resources.ts";
import { Alert } from "../parts/alert.tsx";

/** Fields of a fit, and of its configuration. */
export interface Given {
  fields: { calibration?: "dataset" };
  config: { calibration?: CalibrationPreview["cameras"] };
}

export const NOTHING_GIVEN: Given = { fields: {}, config: {} };

export function CalibrationChoice({ dataset, onChange }: { dataset: Dataset; onChange: (given: Given) => void }) {
  const own = dataset.calibration;
  const [used, setUsed] = useState(own !== null);
  const [chosen, setChosen] = useState<CalibrationPreview | null>(null);
  const [trouble, setTrouble] = useState<string | null>(null);
  useEffect(() => {
    if (chosen !== null) onChange({ fields: {}, config: { calibration: chosen.cameras } });
    else onChange(used && own !== null ? { fields: { calibration: "dataset" }, config: {} } : NOTHING_GIVEN);
    // eslint-disable-next-line react-hooks/exhaustive-deps -- whoever listens is another function each time
  }, [used, chosen, own]);
  const choose = async (files: File[]) => {
    setTrouble(null);
    setChosen(null);
    if (files.length === 0) return;
    await previewCalibration(dataset.id, files).then(setChosen, (error: Error) => setTrouble(error.message));
  };
  return (
    <fieldset
      class="calibration"
      onDragOver={(event) => event.preventDefault()}
      onDrop={(event) => {
        event.preventDefault();
        void choose([...(event.dataTransfer?.files ?? [])]);
      }}
    >
      <legend>
        Cameras that you know <small class="quiet">a calibration gives lenses and places; may be left out</small>
      </legend>
      {own !== null && (
        <label>
          <input
            type="checkbox"
            checked={used && chosen === null}
            disabled={chosen !== null}
            onChange={(event) => setUsed(event.currentTarget.checked)}
          />
          Use the calibration that came with the files{" "}
          <span class="quiet">
            {own.file}: {matched(own.names ?? [], dataset)}
          </span>
        </label>
      )}
      <label class="button chooser">
        {own === null ? "Calibration file" : "Another calibration file"}
        <input
          type="file"
          multiple
          accept=".toml,.yml,.yaml,.json"
          onChange={(event) => void choose([...(event.currentTarget.files ?? [])])}
        />
      </label>
      {chosen !== null && (
        <p role="status">
          {chosen.notes.join("; ")} <span class="quiet">({matched(chosen.names ?? [], dataset)})</span>
        </p>
      )}
      <Alert>{trouble}</Alert>
    </fieldset>
  );
}

/** Returns which camera belongs to which view, in words. */
function matched(names: string[], { view_names: views }: Dataset): string {
  return names
    .map((name, view) => {
      const called = views?.[view] ?? `view ${view}`;
      return name === called ? name : `${name} for ${called}`;
    })
    .join(", ");
}
