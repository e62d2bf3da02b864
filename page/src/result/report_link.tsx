/** Opens the report on a fit, a page of its own, in another tab. */

import { useState } from "preact/hooks";
import { addressOf, ask } from "../api/http.ts";
import { currentKey } from "../api/key.ts";

export function ReportLink({ fit }: { fit: string }) {
  const [trouble, setTrouble] = useState<Error | null>(null);
  const path = `fits/${fit}/report?format=html`;
  const open = (event: MouseEvent) => {
    if (currentKey() === null) return; // the browser needs none, and follows the link
    event.preventDefault();
    setTrouble(null);
    const tab = window.open("about:blank"); // at once, for browsers open none that was not asked for by a click
    ask(path)
      .then((answer) => answer.blob())
      .then((report) => tab?.location.replace(URL.createObjectURL(report)))
      .catch((error: Error) => {
        tab?.close();
        setTrouble(error);
      });
  };
  return (
    <>
      <a href={addressOf(path)} target="_blank" rel="noreferrer" onClick={open}>
        Report
      </a>
      {trouble !== null && <span role="alert"> {trouble.message}</span>}
    </>
  );
}
