/** One of several values, chosen by its words. */

interface Props {
  value: string;
  choices: readonly (readonly [string, string])[]; // values and their words
  "aria-label"?: string;
  onChange: (value: string) => void;
}

export function Choice({ choices, onChange, ...named }: Props) {
  return (
    <select {...named} onChange={(event) => onChange(event.currentTarget.value)}>
      {choices.map(([value, words]) => (
        <option key={value} value={value}>
          {words}
        </option>
      ))}
    </select>
  );
}
