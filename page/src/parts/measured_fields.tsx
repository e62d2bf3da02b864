/** How far two keypoints, or two cameras, are apart. */

import { useState } from "preact/hooks";

export interface Measured {
  ends: [number, number];
  length: number;
}

interface Props {
  of: "keypoint" | "camera";
  names: readonly string[]; // of all that there are
  before?: Measured | null;
  onChange: (measured: Measured | null) => void; // null: not complete
}

export function MeasuredFields({ of, names, before = null, onChange }: Props) {
  const [texts, setTexts] = useState({
    from: `${before?.ends[0] ?? ""}`,
    to: `${before?.ends[1] ?? ""}`,
    length: `${before?.length ?? ""}`,
  });
  const edit = (part: Partial<typeof texts>) => {
    const next = { ...texts, ...part };
    setTexts(next);
    const [from, to, length] = [Number(next.from), Number(next.to), Number(next.length)];
    const complete = next.from !== "" && next.to !== "" && next.length !== "";
    onChange(complete ? { ends: [from, to], length } : null);
  };
  const choice = (which: "from" | "to", label: string) => (
    <select aria-label={label} value={texts[which]} onChange={(e) => edit({ [which]: e.currentTarget.value })}>
      <option value="">–</option>
      {names.map((name, index) => (
        <option key={index} value={index}>
          {name}
        </option>
      ))}
    </select>
  );
  return (
    <>
      from
      {choice("from", `From ${of}`)}
      to
      {choice("to", `To ${of}`)}
      is
      <input
        aria-label={`${of === "camera" ? "Distance" : "Length"}, in metres for instance`}
        type="number"
        min={0}
        step="any"
        placeholder={of === "camera" ? "2.5" : "0.42"}
        value={texts.length}
        onInput={(e) => edit({ length: e.currentTarget.value })}
      />
      <span class="quiet">in metres, say: it is the unit of all that comes out</span>
    </>
  );
}
