"""HDF5 files that hold all of their data themselves.

HDF5 lets a file take data from other files: by links, by external storage, by virtual datasets. A
reader that follows these gives access to any file that its user may read, so a crafted file could
make the reader send back others. Files as detectors write them have none of these.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fewview.errors import FormatError
from fewview.readers.budget import take
from fewview.readers.views import bounded

MAX_OBJECTS = 100_000  # groups and datasets
MAX_DEPTH = 32  # of groups in groups
MAX_BYTES = 2**32  # of a dataset that is read, uncompressed
# The filters that the library has built in: it would load any other as a program.
FILTERS = frozenset({1, 2, 3, 4, 5, 6, 32000})  # deflate to scaleoffset, and h5py's LZF
OTHER_FILES = "which can read other files; copy the data into the file itself"


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open an HDF5 file for reading, as an `h5py.File`.

    Raises
    ------
    FormatError
        If it is broken, or holds a link, a dataset or a reference that leads elsewhere.
    """
    import h5py  # noqa: PLC0415 (heavy)

    try:
        file = h5py.File(path, "r")
    except (OSError, RuntimeError) as error:
        raise FormatError(f"no HDF5 file, or a broken one ({error})", place=path) from error
    with file:
        _check(file, str(path))
        yield file


def text(value: Any) -> str:
    """Return text as a string, however it is stored; "" of anything else."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return str(value) if isinstance(value, str | np.str_) else ""


def values(dataset: Any, what: str) -> Any:
    """Return what a dataset holds, of bounded size.

    Raises
    ------
    FormatError
        If it is no dataset, or too large, or holds references.
    """
    shape = getattr(dataset, "shape", None)
    if shape is None:
        raise FormatError(
            f"{_name(dataset)} is a group, or empty, where an array should be", place=what
        )
    bounded(shape, f"{what}: {_name(dataset)}")
    size = math.prod(shape) * dataset.dtype.itemsize
    if size > MAX_BYTES:
        raise FormatError(f"{_name(dataset)} is too large; cut it in parts", place=what)
    if _refers(dataset.id.get_type()):
        raise FormatError(f"{_name(dataset)} holds references, which are not followed", place=what)
    take(size, what)
    return dataset[()]


def _name(item: Any) -> str:
    """Return where in its file something is."""
    return str(item.name).lstrip("/")


def _check(file: Any, what: str) -> None:
    """Walk all links without following any that leads out of its group."""
    import h5py  # noqa: PLC0415 (heavy)

    # NWB links groups of a file to each other. Such links and references lead to nothing but what
    # is in the file, whose links to others are refused wherever they are.
    inner = text(file.attrs.get("neurodata_type", "")) == "NWBFile"
    groups = [(file, 0)]
    seen: set[Any] = set()
    count = 0
    while groups:
        group, depth = groups.pop()
        if not inner:
            _check_attributes(group, what)
        for name in group:
            count += 1
            path = f"{_name(group)}/{name}".lstrip("/")
            if count > MAX_OBJECTS or depth > MAX_DEPTH:
                raise FormatError(
                    f"has more than {MAX_OBJECTS:,} groups and datasets, or more than "
                    f"{MAX_DEPTH} groups within each other",
                    place=what,
                )
            if inner and _is_soft(group, name):
                continue
            if not is_hard(group, name):
                raise FormatError(f"{path} is a link to a name, {OTHER_FILES}", place=what)
            item = group[name]
            if isinstance(item, h5py.Dataset):
                _check_dataset(item, what, may_refer=inner)
            elif isinstance(item, h5py.Group):
                at = h5py.h5o.get_info(item.id).addr
                if at not in seen:  # hard links can make circles
                    seen.add(at)
                    groups.append((item, depth + 1))
            else:
                raise FormatError(f"{path} is no group and no dataset", place=what)


def is_hard(group: Any, name: str) -> bool:
    """Whether something is in a group itself, and no link to elsewhere."""
    import h5py  # noqa: PLC0415 (heavy)

    try:
        return isinstance(group.get(name, getlink=True), h5py.HardLink)
    except TypeError:  # of a kind that users define
        return False


def _is_soft(group: Any, name: str) -> bool:
    import h5py  # noqa: PLC0415 (heavy)

    try:
        return isinstance(group.get(name, getlink=True), h5py.SoftLink)
    except TypeError:
        return False


def _check_dataset(dataset: Any, what: str, *, may_refer: bool) -> None:
    # Before its shape is asked for, which opens the files of a virtual dataset.
    if dataset.is_virtual:
        raise FormatError(f"{_name(dataset)} is a virtual dataset, {OTHER_FILES}", place=what)
    if dataset.external is not None:
        raise FormatError(f"{_name(dataset)} has external storage, {OTHER_FILES}", place=what)
    plist = dataset.id.get_create_plist()
    filters = {plist.get_filter(place)[0] for place in range(plist.get_nfilters())}
    if not filters <= FILTERS:
        raise FormatError(
            f"{_name(dataset)} is compressed by a filter that is not HDF5's own; write it with "
            "gzip",
            place=what,
        )
    if may_refer:  # `values` reads none
        return
    if _refers(dataset.id.get_type()):
        raise FormatError(f"{_name(dataset)} holds references, which are not followed", place=what)
    _check_attributes(dataset, what)


def _check_attributes(item: Any, what: str) -> None:
    """Refuse references, except those of dimension scales, which are not read here."""
    for name in item.attrs:
        kind = item.attrs.get_id(name).get_type()
        if name not in ("DIMENSION_LIST", "REFERENCE_LIST") and _refers(kind):
            raise FormatError(f"the attribute {name} of {_name(item)} holds references", place=what)


def _refers(kind: Any) -> bool:
    """Whether values of this type of HDF5's are references, or hold any."""
    import h5py  # noqa: PLC0415 (heavy)

    if isinstance(kind, h5py.h5t.TypeReferenceID):
        return True
    if isinstance(kind, h5py.h5t.TypeCompoundID):
        return any(_refers(kind.get_member_type(n)) for n in range(kind.get_nmembers()))
    if isinstance(kind, h5py.h5t.TypeArrayID | h5py.h5t.TypeVlenID):
        return _refers(kind.get_super())
    return False
