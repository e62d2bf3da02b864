"""The CRC-32 of bytes that lie in parts, from those of the parts."""

from functools import lru_cache

_POLYNOMIAL = 0xEDB88320  # of zip and zlib, the lowest power in the highest bit
_ONE = 1 << 31


def combine(first: int, second: int, second_bytes: int) -> int:
    """Return the CRC-32 of two runs of bytes, one after the other.

    As ``crc32_combine`` of zlib, which Python does not offer: the first checksum, times x to the
    number of bits that follow, in the field of polynomials over two elements.

    Parameters
    ----------
    first, second
        The result of ``zlib.crc32`` for each run.
    second_bytes
        The length of the second.
    """
    return _times(_power(8 * second_bytes), first) ^ second


def _times(a: int, b: int) -> int:
    product = 0
    while a:
        if a & _ONE:
            product ^= b
        a = a << 1 & 0xFFFFFFFF
        b = b >> 1 ^ (_POLYNOMIAL if b & 1 else 0)
    return product


@lru_cache(maxsize=64)  # the chunks of a lift have few lengths
def _power(exponent: int) -> int:
    """Return x to an exponent."""
    result, square = _ONE, _ONE >> 1
    while exponent:
        if exponent & 1:
            result = _times(result, square)
        square = _times(square, square)
        exponent >>= 1
    return result
