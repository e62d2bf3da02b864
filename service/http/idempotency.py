"""The ``Idempotency-Key`` header."""

from fastapi import Request

from store.idempotency import Idempotency


def idempotency(request: Request, key: str | None, fingerprint: str) -> Idempotency | None:
    """Return the key of a creating request, unique to its method and path."""
    if key is None:
        return None
    scope = f"{request.method} {request.url.path}"[:200]
    return Idempotency(scope, key, f"{fingerprint}?{request.url.query}"[:200])
