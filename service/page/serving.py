"""Serves the page at ``/``, and the files that it is made of below ``/page/``."""

from pathlib import Path

from fastapi import FastAPI, Request
from starlette.responses import HTMLResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from service.http.authentication import PAGE_FILES
from service.report.document import STYLE_SOURCE

BUILT = Path(__file__).with_name("built")  # by `page/build.py`; not in the repository
FOR_EVER = "public, max-age=31536000, immutable"  # names of files change with their content
# Scripts, styles and requests of the page's own origin alone; pictures and films of the viewer's
# disk, too, which are never sent. What the page opens has its policy, a report with its style, too.
POLICY = (
    f"default-src 'self'; style-src 'self' {STYLE_SOURCE}; img-src 'self' blob:; "
    "media-src 'self' blob:; object-src 'none'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
HEADERS = {"Content-Security-Policy": POLICY, "Cache-Control": "no-cache"}
NOT_BUILT = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Fewview</title>
<h1>Fewview</h1>
<p>The service runs, but its page was not built. In a clone of the repository
<code>make page</code> builds it, with packages of the npm registry; then load this again.
An installed wheel has the page in it.</p>
<p>The API needs no page: <a href="docs">its documentation</a>.</p>
</html>
"""


class ImmutableFiles(StaticFiles):
    """Files that never change under their names."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Answer with a file, to be kept for ever."""
        response = await super().get_response(path, scope)
        response.headers["Cache-Control"] = FOR_EVER
        return response


def serve_page(app: FastAPI, built: Path = BUILT) -> None:
    """Add the page to the application; if it was not built, add a note on how to build it."""

    async def show(_request: Request) -> Response:
        try:
            return HTMLResponse((built / "index.html").read_bytes(), headers=HEADERS)
        except FileNotFoundError:
            return HTMLResponse(NOT_BUILT, headers=HEADERS)

    app.add_route("/", show, methods=["GET"], include_in_schema=False)
    files = ImmutableFiles(directory=built / "page", check_dir=False)
    files.config_checked = True  # the page may be built while the service runs
    app.mount(PAGE_FILES, files, name="page")
