/** The unit of a fit's structures. */

import type { Model } from "../api/resources.ts";

type Config = Model["config"];

/** Returns what lengths are counted in. Which unit a given length has nobody states, so its name is
 * not known; without one the structure's own size is the unit. */
export function unitOf(config: Config): string {
  if (config.known_length) return "unit of the known length";
  return hasUnit(config) ? "unit of the calibration" : "no unit: no length was given";
}

/** Returns whether lengths were given to a fit: one of the subject, or the poses of two cameras. */
export function hasUnit(config: Config): boolean {
  const posed = (config.calibration ?? []).filter((camera) => camera?.translation);
  return Boolean(config.known_length) || posed.length > 1;
}
