/** The unit of a fit's structures. */

import type { Fit, Model } from "../api/resources.ts";

type Fitted = Pick<Model, "config" | "findings">;

/** Returns what is known of a result's unit: of its model or, of a first answer, of the fit. */
export function fittedOf(fit: Fit, model: Model | null): Fitted {
  return model ?? { config: fit.config ?? {}, findings: fit.findings };
}

/** Returns what lengths are counted in. Which unit a given length has nobody states, so its name is
 * not known; without one the structure's own size is the unit. */
export function unitOf(model: Fitted): string {
  if (model.config.known_length) return "unit of the known length";
  if (usesDistance(model)) return "unit of the known distance";
  return hasUnit(model) ? "unit of the calibration" : "no unit: no length was given";
}

/** Returns whether lengths were given to a fit: one of the subject, or of the places of two cameras. */
export function hasUnit(model: Fitted): boolean {
  const posed = (model.config.calibration ?? []).filter((camera) => camera?.translation);
  return Boolean(model.config.known_length) || usesDistance(model) || posed.length > 1;
}

const USELESS = ["known_distance_not_used", "cameras_not_found"];

function usesDistance({ config, findings }: Fitted): boolean {
  return Boolean(config.known_distance) && !findings.some(({ code }) => USELESS.includes(code));
}
