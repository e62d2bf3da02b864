"""Files that are nearly right: bytes flipped, cut, doubled, and numbers that are far too large."""

import random
import re
from collections.abc import Iterator

HUGE = (b"1e999", b"-1", b"4294967295", b"1e300", b"null", b'"x"', b"[]", b"{}", b"NaN")
_NUMBER = re.compile(rb"(?<![\w.])\d+(?:\.\d+)?(?![\w.])")


def mutated(whole: bytes, count: int) -> Iterator[bytes]:
    """Yield so many mutations of a file, the same at every call."""
    for seed in range(count):
        rng = random.Random(seed)  # noqa: S311  # no secret
        data = bytearray(whole)
        for _ in range(rng.choice((1, 1, 2, 8))):
            at = rng.randrange(len(data))
            kind = rng.randrange(6)
            if kind == 0:
                data[at] ^= 1 << rng.randrange(8)
            elif kind == 1:
                data[at] = rng.choice((0, 255, 127, 128))
            elif kind == 2:
                del data[at : at + rng.randrange(1, 64)]
            elif kind == 3:
                data[at:at] = data[at : at + rng.randrange(1, 200)]
            elif found := _NUMBER.search(data, at):
                data[found.start() : found.end()] = rng.choice(HUGE)
            else:
                del data[max(at, 1) :]
        yield bytes(data)
