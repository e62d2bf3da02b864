/** Draws a component into the document, and finds what a user finds: by role and name. */

import { within } from "@testing-library/dom";
import { render, type ComponentChild } from "preact";
import { act } from "preact/test-utils";

export async function rendered(component: ComponentChild) {
  const place = document.createElement("main");
  document.body.replaceChildren(place);
  await act(() => render(component, place));
  return { place, ...within(place) };
}

/** Clicks, or types, and waits for what comes of it. */
export async function happens(element: HTMLElement, event: string, value?: string): Promise<void> {
  await act(() => {
    if (value !== undefined) (element as HTMLInputElement).value = value;
    element.dispatchEvent(new Event(event, { bubbles: true }));
  });
}
