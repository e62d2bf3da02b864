"""Which methods a path has: the ``Allow`` header of a 405 (RFC 9110, 15.5.6)."""

from fastapi import Request
from starlette.routing import BaseRoute, Match, Mount
from starlette.types import Scope

METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE")


def allow(request: Request) -> str:
    """Return the methods that the path of a request has in all its routes together.

    A router names those of one route alone. HEAD is answered wherever GET is.
    """
    # A router has made the scope its own; the root of the application is kept apart.
    root = request.scope.get("app_root_path", request.scope.get("root_path", ""))
    scope = {**request.scope, "root_path": root}
    routes: list[BaseRoute] = request.app.routes
    return ", ".join(
        method for method in METHODS if any(_has(route, scope, method) for route in routes)
    )


def _has(route: BaseRoute, scope: Scope, method: str) -> bool:
    asked = "GET" if method == "HEAD" else method  # as `Head` has it
    match, _ = route.matches({**scope, "method": asked})
    # What is mounted takes any method: files, which are read alone.
    return match is Match.FULL and (asked == "GET" or not isinstance(route, Mount))
