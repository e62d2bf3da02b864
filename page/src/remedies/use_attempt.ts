/** Something that is asked of the service at a click: whether it goes on, and what went wrong. */

import { useState } from "preact/hooks";

export function useAttempt() {
  const [busy, setBusy] = useState(false);
  const [trouble, setTrouble] = useState<string | null>(null);
  const attempt = (work: () => Promise<void>) => {
    setBusy(true);
    setTrouble(null);
    void work()
      .catch((error: Error) => setTrouble(error.message))
      .finally(() => setBusy(false));
  };
  return { busy, trouble, attempt };
}
