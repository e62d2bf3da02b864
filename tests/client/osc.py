"""OSC as the library of others reads it."""

from typing import Any

import pytest


def read_osc(data: bytes) -> list[tuple[str, list[Any]]]:
    """Return the messages of a bundle as the library of others reads them."""
    other = pytest.importorskip("pythonosc.osc_bundle", reason="python-osc is not installed")
    return [(each.address, each.params) for each in other.OscBundle(data)]
