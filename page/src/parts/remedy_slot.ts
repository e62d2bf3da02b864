/** Where controls stand beside the words of a remedy. Whoever shows findings of something that can be
 * mended gives what makes them (`remedies/provider.tsx`); elsewhere there are the words alone. */

import { createContext, type ComponentChildren } from "preact";
import type { Finding } from "../api/resources.ts";

export const RemedySlot = createContext<((finding: Finding) => ComponentChildren) | null>(null);
