/** Which keypoints are of the left and of the right side, by their names. */

export type Side = -1 | 0 | 1; // left, neither, right

const SWAPS: [RegExp, (found: string) => string][] = [
  [/left|right/i, (found) => swapWord(found)],
  [/^[lr](?=[^a-z0-9]|[a-z0-9]{2})/i, (found) => swapLetter(found)], // lwrist, L_wrist, LWrist
  [/(?<=[^a-zA-Z0-9])[lr]$/i, (found) => swapLetter(found)], // wrist_l, wrist.R
  [/(?<=[a-z0-9])[LR]$/, (found) => swapLetter(found)], // wristL
  [/(?<=[^a-zA-Z0-9])[lr](?=[^a-zA-Z0-9])/i, (found) => swapLetter(found)], // eye_l_inner
];

/** Returns the side of each keypoint. A name counts as one of a side only if its mirror image is a
 * name, too: `lowerback` is not on the left, for nothing is called `rowerback`. */
export function sidesOf(names: readonly string[]): Side[] {
  const known = new Set(names);
  return names.map((name) => {
    for (const [pattern, swap] of SWAPS) {
      const found = pattern.exec(name)?.[0];
      if (found !== undefined && known.has(name.replace(pattern, swap))) {
        return found.toLowerCase().startsWith("l") ? -1 : 1;
      }
    }
    return 0;
  });
}

function swapWord(found: string): string {
  const other = found.toLowerCase() === "left" ? "right" : "left";
  if (found === found.toUpperCase()) return other.toUpperCase();
  return found[0] === found[0]!.toUpperCase() ? other[0]!.toUpperCase() + other.slice(1) : other;
}

function swapLetter(found: string): string {
  return { l: "r", r: "l", L: "R", R: "L" }[found] ?? found;
}
