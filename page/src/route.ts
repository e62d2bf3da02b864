/** Where in the page one is: the part of the address behind `#`, which no proxy and no API sees. */

export interface Route {
  path: string[];
  query: URLSearchParams;
}

export function currentRoute(): Route {
  const [path = "", query = ""] = location.hash.replace(/^#\/?/, "").split("?", 2);
  return { path: path.split("/").filter(Boolean).map(decodeURIComponent), query: new URLSearchParams(query) };
}

/** Returns the frame that a link names; 0 without one. */
export function frameInAddress(): number {
  return Number(currentRoute().query.get("frame") ?? 0) || 0;
}

export function linkTo(...path: string[]): string {
  return `#/${path.map(encodeURIComponent).join("/")}`;
}

export function goTo(...path: string[]): void {
  location.hash = linkTo(...path);
}

/** Changes the query of the address without a step in the browser's history. */
export function keepInAddress(query: Record<string, string>): void {
  const { path } = currentRoute();
  const behind = new URLSearchParams(query).toString();
  history.replaceState(history.state, "", `${linkTo(...path)}${behind && `?${behind}`}`);
}
