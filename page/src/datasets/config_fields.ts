/** Reads the fields of `FitConfig` out of the service's OpenAPI document. */

export interface Field {
  name: string;
  kind: "number" | "integer" | "boolean" | "choice";
  choices: string[];
  standard: string; // the default, as it is shown
  description: string;
}

interface Schema {
  type?: string;
  enum?: unknown[];
  const?: unknown;
  anyOf?: Schema[];
  $ref?: string;
  default?: unknown;
  description?: string;
  properties?: Record<string, Schema>;
}

interface Document {
  components: { schemas: Record<string, Schema> };
}

/** Returns the fields that are a number, a choice or yes and no; others are for scripts. */
export function fieldsOf(document: Document): Field[] {
  const schemas = document.components.schemas;
  const config = schemas.FitConfig?.properties ?? {};
  return Object.entries(config).flatMap(([name, schema]) => {
    const options = simple(schema, schemas);
    const choices = options.flatMap((option) => {
      if (option.type === "boolean") return ["true", "false"];
      return (option.enum ?? (option.const === undefined ? [] : [option.const])).map(String);
    });
    const numeric = options.find((option) => option.type === "number" || option.type === "integer");
    const kind =
      choices.length > 0
        ? options.every((option) => option.type === "boolean")
          ? "boolean"
          : "choice"
        : (numeric?.type as "number" | "integer" | undefined);
    if (kind === undefined || options.some((option) => option.type === "array" || option.type === "object")) return [];
    const standard = `${(schema.default ?? "none") as string | number | boolean}`;
    return [{ name, kind, choices, standard, description: schema.description ?? "" }];
  });
}

/** Returns the value that was typed; undefined for none, which leaves the default. */
export function valueOf(field: Field, text: string): unknown {
  if (text === "") return undefined;
  if (field.kind === "number" || field.kind === "integer") return Number(text);
  return text === "true" ? true : text === "false" ? false : text;
}

/** Returns the alternatives of a schema, references followed, without null. */
function simple(schema: Schema, schemas: Record<string, Schema>): Schema[] {
  if (schema.$ref !== undefined) {
    const target = schemas[schema.$ref.split("/").at(-1) ?? ""];
    return target === undefined ? [] : simple(target, schemas);
  }
  if (schema.anyOf !== undefined) return schema.anyOf.flatMap((each) => simple(each, schemas));
  return schema.type === "null" ? [] : [schema];
}
