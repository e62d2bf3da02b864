"""The ``Idempotency-Key`` header."""

import hashlib
import json

from fastapi import Request

from service.http.uploads import Upload
from store.idempotency import Idempotency


def idempotency(request: Request, key: str | None, upload: Upload) -> Idempotency | None:
    """Return the key of a creating request, unique to its method and path."""
    if key is None:
        return None
    scope = f"{request.method} {request.url.path}"[:200]
    return Idempotency(scope, key, _digest(request, upload), _older_digest(request, upload))


def _digest(request: Request, upload: Upload) -> str:
    """Return the SHA-256 of everything in a request that its result may depend on.

    For a form these are its fields and files instead of its bytes, because clients that send it
    again choose another boundary.
    """
    whole = [
        request.method,
        request.url.path,
        sorted(request.query_params.multi_items()),
        upload.is_json,
        hashlib.sha256(upload.data).hexdigest(),
        sorted(upload.fields.items()),
        [
            (file.name, hashlib.sha256(file.data).hexdigest(), *(["folders"] * file.holds_folders))
            for file in upload.files
        ],
    ]
    return hashlib.sha256(json.dumps(whole).encode()).hexdigest()


def _older_digest(request: Request, upload: Upload) -> str | None:
    """Return the digest that older versions recorded, for requests repeated across an upgrade.

    Keys are kept for a day. None if the older digest was cut off at 200 characters, for it then
    does not identify one request.
    """
    digest = hashlib.sha256(upload.data)
    for file in upload.files[1:]:
        name = f"\0{file.name}\0".encode(errors="replace")
        digest.update(name + hashlib.sha256(file.data).digest())
    for field, text in sorted(upload.fields.items()):
        digest.update(f"\0{field}\0{text}".encode(errors="replace"))
    noted = f"{digest.hexdigest()}?{request.url.query}"
    return noted if len(noted) < 200 else None
