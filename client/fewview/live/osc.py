"""Messages and bundles of OSC, as bytes.

Source: M. Wright, "The Open Sound Control 1.0 Specification", 2002.
"""

import struct
from collections.abc import Iterable, Iterator

BUNDLE = b"#bundle\0" + struct.pack(">Q", 1)  # the time tag "at once"
LONGEST_BUNDLE = 1400  # bytes, so that a bundle fits into one packet of a usual network

Value = str | int | float


def message(address: str, *values: Value) -> bytes:
    """Return a message with texts, integers (32 bits) and numbers (float32)."""
    tags, data = ",", b""
    for value in values:
        if isinstance(value, str):
            tags, data = tags + "s", data + _text(value)
        elif isinstance(value, int):
            tags, data = tags + "i", data + struct.pack(">i", value)
        else:
            tags, data = tags + "f", data + struct.pack(">f", value)
    return _text(address) + _text(tags) + data


def bundles(messages: Iterable[bytes]) -> Iterator[bytes]:
    """Give bundles of messages in their order, each short enough for one packet."""
    bundle = BUNDLE
    for each in messages:
        part = struct.pack(">i", len(each)) + each
        if len(bundle) > len(BUNDLE) and len(bundle) + len(part) > LONGEST_BUNDLE:
            yield bundle
            bundle = BUNDLE
        bundle += part
    if len(bundle) > len(BUNDLE):
        yield bundle


def _text(text: str) -> bytes:
    """Return a text that ends in one to four zeros, to a multiple of four bytes."""
    data = text.replace("\0", "").encode("utf-8", "replace")
    return data + bytes(4 - len(data) % 4)
