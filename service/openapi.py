"""``python -P -m service.openapi`` prints the OpenAPI document, as in ``docs/openapi.json``."""

import json

from service.app import create_app
from service.settings import Settings


def document() -> str:
    """Return the OpenAPI document as indented JSON."""
    return json.dumps(create_app(Settings()).openapi(), indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    print(document(), end="")
