"""Headers of NumPy's arrays in files, which give the size of an array before it is read."""

from typing import IO, Any, NamedTuple

import numpy as np


class Header(NamedTuple):
    """Shape, whether the order is Fortran's, and type of an array in a file."""

    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[Any]


def read_header(name: str, stream: IO[bytes]) -> Header:
    """Read the header of an array, and leave the stream at its first value.

    Parameters
    ----------
    name
        Of the array, for the message.

    Raises
    ------
    ValueError
        If the header is malformed.
    EOFError, OSError
        If the stream ends, or cannot be read.
    """
    try:
        version = np.lib.format.read_magic(stream)
        read = (
            np.lib.format.read_array_header_1_0
            if version == (1, 0)
            else np.lib.format.read_array_header_2_0
        )
        header = Header(*read(stream))
    except (EOFError, OSError, MemoryError):
        raise
    except Exception as error:  # NumPy parses it as Python, and lets through what that raises
        raise ValueError(f"the array {name!r} has a malformed header: {error}") from error
    if not all(type(length) is int and length >= 0 for length in header.shape):
        raise ValueError(f"the array {name!r} has a malformed header: its shape is {header.shape}")
    return header
