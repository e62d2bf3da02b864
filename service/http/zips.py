"""Zip files of arrays, whose directory is looked at within bounds before anything is unpacked."""

import io
import lzma
import struct
import zipfile
import zlib

ZIP_MAGIC = b"PK\x03\x04"
MAX_MEMBERS = 64  # of a zip file of arrays
# Of the directory, and of the comment where the end of it is looked for; an entry has 46 at least.
MAX_DIRECTORY_BYTES = 128 * 1024
# What a zip file that is none, or a broken one, raises while it is read.
ZIP_FAULTS = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    OverflowError,
    RuntimeError,  # encrypted members, unknown compression
    ValueError,
)


class TooManyMembersError(Exception):
    """A zip file has more members than one of arrays has."""


class _Directory(io.BytesIO):
    """A zip file of which no more is read at a time than a directory of bounded size."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self._size = len(data)

    def read(self, size: int | None = -1) -> bytes:
        left = self._size - self.tell()
        asked = left if size is None or size < 0 else min(size, left)
        if asked > MAX_DIRECTORY_BYTES:
            raise TooManyMembersError
        return super().read(asked)


def members_of(data: bytes) -> list[zipfile.ZipInfo]:
    """Return what a zip file of arrays lists; time and memory are bounded, whatever it holds.

    ``zipfile`` reads the whole directory at once, and makes an object of each entry. What it
    reads is bounded here rather than what the file claims of it: there are two such claims.

    Raises
    ------
    TooManyMembersError
        If it lists more than `MAX_MEMBERS`.
    Exception
        One of `ZIP_FAULTS`, if it is broken.
    """
    with zipfile.ZipFile(_Directory(data)) as archive:
        members = archive.infolist()
    if len(members) > MAX_MEMBERS:
        raise TooManyMembersError
    return members
