/** The unit of a fit's structures. */

import type { Fit } from "../api/resources.ts";

/** Returns what lengths are counted in. Which unit a given length has nobody states, so its name is
 * not known; without one the structure's own size is the unit. */
export function unitOf(fit: Fit): string {
  const config = fit.config;
  if (config?.known_length) return "unit of the known length";
  const posed = (config?.calibration ?? []).filter((camera) => camera?.translation);
  if (posed.length > 1) return "unit of the calibration";
  return "no unit: no length was given";
}
