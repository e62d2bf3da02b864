"""Serves the documentation of the API at ``/docs``, with its scripts, so that it works offline."""

from base64 import b64encode
from hashlib import sha256

from fastapi import FastAPI, Request
from starlette.responses import HTMLResponse, Response
from starlette.staticfiles import StaticFiles

from service.http.authentication import DOCUMENTATION
from service.http.safe_headers import POLICY

ASSETS = f"{DOCUMENTATION}/assets"
# Requests that are tried out have the key that the page has in this tab.
SCRIPT = """
const ui = SwaggerUIBundle({
  url: "openapi.json",
  dom_id: "#swagger-ui",
  deepLinking: true,
  showExtensions: true,
  presets: [SwaggerUIBundle.presets.apis, SwaggerUIBundle.SwaggerUIStandalonePreset],
  onComplete() {
    const key = sessionStorage.getItem("fewview-key");
    if (key !== null) ui.preauthorizeApiKey("bearer", key);
  },
});
"""
HTML = f"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Fewview</title>
<link rel="stylesheet" href="{ASSETS[1:]}/swagger-ui.css">
<link rel="icon" href="{ASSETS[1:]}/favicon.png">
<div id="swagger-ui"></div>
<script src="{ASSETS[1:]}/swagger-ui-bundle.js"></script>
<script>{SCRIPT}</script>
</html>
"""
# This script alone, by its digest; Swagger UI sets styles of its elements, and draws from data.
HEADERS = {
    POLICY.decode(): "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    f"script-src 'self' 'sha256-{b64encode(sha256(SCRIPT.encode()).digest()).decode()}'; "
    "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
}


def serve_documentation(app: FastAPI) -> None:
    """Add the documentation to the application."""

    async def show(_request: Request) -> Response:
        return HTMLResponse(HTML, headers=HEADERS)

    app.mount(ASSETS, StaticFiles(packages=[("fastapi_offline", "static")]), name="docs_assets")
    app.add_route(DOCUMENTATION, show, include_in_schema=False)
