"""The client of Fewview: captures from files, fits and lifts over HTTP, animations to files.

Names are loaded when they are first used, so that importing this costs next to nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fewview.animation import Animation
    from fewview.api.lifting import Lift
    from fewview.capture import Capture
    from fewview.client import AsyncClient, Client
    from fewview.errors import (
        ApiError,
        Conflict,
        ConnectionFailed,
        FewviewError,
        Forbidden,
        FormatError,
        InvalidRequest,
        JobFailed,
        NotFound,
        TooManyRequests,
        Unauthorized,
        Unavailable,
    )
    from fewview.readers import read
    from fewview.writers import write

# Where each name is; those of one module on a line.
_NAMES = {
    "animation": ("Animation",),
    "capture": ("Capture",),
    "client": ("AsyncClient", "Client"),
    "api.lifting": ("Lift",),
    "errors": (
        "ApiError",
        "Conflict",
        "ConnectionFailed",
        "FewviewError",
        "Forbidden",
        "FormatError",
        "InvalidRequest",
        "JobFailed",
        "NotFound",
        "TooManyRequests",
        "Unauthorized",
        "Unavailable",
    ),
    "readers": ("read",),
    "writers": ("write",),
}
_PLACES = {name: f"fewview.{module}" for module, names in _NAMES.items() for name in names}

__all__ = [
    "Animation",
    "ApiError",
    "AsyncClient",
    "Capture",
    "Client",
    "Conflict",
    "ConnectionFailed",
    "FewviewError",
    "Forbidden",
    "FormatError",
    "InvalidRequest",
    "JobFailed",
    "Lift",
    "NotFound",
    "TooManyRequests",
    "Unauthorized",
    "Unavailable",
    "read",
    "write",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'fewview' has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
