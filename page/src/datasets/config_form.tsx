/** What a fit can be given. The advanced fields come from the schema of `FitConfig`, with its words. */

import { useEffect, useState } from "preact/hooks";
import { askJson } from "../api/http.ts";
import type { Dataset } from "../api/resources.ts";
import { words } from "../parts/format.ts";
import { viewNames } from "../remedies/subject.ts";
import { LensFields, type Lens } from "../parts/lens_fields.tsx";
import { MeasuredFields, type Measured } from "../parts/measured_fields.tsx";
import { fieldsOf, valueOf, type Field } from "./config_fields.ts";

/** What people change; the other fields are behind a fold of their own. */
const USUAL = ["cameras", "cameras_alike", "refine", "steps", "seed"];

type Texts = Record<string, string>;

export function ConfigForm({
  dataset,
  onChange,
}: {
  dataset: Dataset;
  onChange: (config: Record<string, unknown>) => void;
}) {
  const [texts, setTexts] = useState<Texts>({});
  const [length, setLength] = useState<Measured | null>(null);
  const [distance, setDistance] = useState<Measured | null>(null);
  const [lenses, setLenses] = useState<(Lens | null)[] | null>(null);
  const [fields, setFields] = useState<Field[] | null>(null);
  const names = dataset.skeleton?.keypoint_names ?? Array.from({ length: dataset.keypoints }, (_, index) => `${index}`);
  const cameras = viewNames(dataset);

  useEffect(() => {
    const config: Record<string, unknown> = {};
    for (const field of fields ?? []) {
      const value = valueOf(field, texts[field.name] ?? "");
      if (value !== undefined) config[field.name] = value;
    }
    if (length !== null) config.known_length = { keypoints: length.ends, length: length.length };
    if (distance !== null) config.known_distance = { views: distance.ends, length: distance.length };
    if (lenses !== null) config.lenses = lenses;
    onChange(config);
    // eslint-disable-next-line react-hooks/exhaustive-deps -- whoever listens is another function each time
  }, [texts, length, distance, lenses, fields]);

  const open = async (event: Event) => {
    if (!(event.currentTarget as HTMLDetailsElement).open || fields !== null) return;
    setFields(fieldsOf(await askJson("openapi.json")));
  };
  return (
    <div class="config">
      <fieldset class="measured-fields">
        <legend>
          A length that you know <small class="quiet">gives the structures a unit; may be left out</small>
        </legend>
        <MeasuredFields of="keypoint" names={names} onChange={setLength} />
      </fieldset>
      {cameras.length > 1 && (
        <fieldset class="measured-fields">
          <legend>
            A distance of two cameras that you know{" "}
            <small class="quiet">gives a unit, too, if they do not move; may be left out</small>
          </legend>
          <MeasuredFields of="camera" names={cameras} onChange={setDistance} />
        </fieldset>
      )}
      <fieldset class="known-lenses">
        <legend>
          What you know of the lenses <small class="quiet">decides most for two cameras; may be left out</small>
        </legend>
        <LensFields names={cameras} onChange={setLenses} />
      </fieldset>
      <details onToggle={(event) => void open(event)}>
        <summary>Advanced</summary>
        {fields === null ? (
          <p class="quiet">Loading …</p>
        ) : (
          <>
            <Fields fields={fields.filter(({ name }) => USUAL.includes(name))} texts={texts} setTexts={setTexts} />
            <details>
              <summary>All other settings</summary>
              <Fields fields={fields.filter(({ name }) => !USUAL.includes(name))} texts={texts} setTexts={setTexts} />
            </details>
          </>
        )}
      </details>
    </div>
  );
}

interface FieldsProps {
  fields: Field[];
  texts: Texts;
  setTexts: (texts: Texts) => void;
}

function Fields({ fields, texts, setTexts }: FieldsProps) {
  const [explained, setExplained] = useState<string | null>(null); // the field whose help is open
  return (
    <div class="fields advanced">
      {fields.map((field) => (
        <div class="field" key={field.name}>
          <span class="named-field">
            <label for={`config-${field.name}`}>{words(field.name)}</label>
            <button
              type="button"
              class="help"
              aria-label={`What ${words(field.name)} means`}
              aria-expanded={explained === field.name}
              aria-controls={`about-${field.name}`}
              onClick={() => setExplained(explained === field.name ? null : field.name)}
            >
              ?
            </button>
          </span>
          <Input
            field={field}
            text={texts[field.name] ?? ""}
            onText={(text) => setTexts({ ...texts, [field.name]: text })}
          />
          <small class="quiet" id={`about-${field.name}`} hidden={explained !== field.name}>
            {field.description.replaceAll("`", "")}
          </small>
        </div>
      ))}
    </div>
  );
}

function Input({ field, text, onText }: { field: Field; text: string; onText: (text: string) => void }) {
  const named = { id: `config-${field.name}`, "aria-describedby": `about-${field.name}` };
  if (field.choices.length > 0) {
    return (
      <select {...named} value={text} onChange={(event) => onText(event.currentTarget.value)}>
        <option value="">default: {field.standard}</option>
        {field.choices.map((choice) => (
          <option key={choice}>{choice}</option>
        ))}
      </select>
    );
  }
  return (
    <input
      {...named}
      type="number"
      step={field.kind === "integer" ? 1 : "any"}
      placeholder={`default: ${field.standard}`}
      value={text}
      onInput={(event) => onText(event.currentTarget.value)}
    />
  );
}
