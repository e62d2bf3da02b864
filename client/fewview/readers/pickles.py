"""Reading pickles without running anything of them: NumPy arrays and plain containers only.

Nothing that a pickle names is imported or called. Arrays are laid out by a few classes below from
the bytes that the pickle holds, and everything else that is named is refused.
"""

import io
import pickle
from typing import Any, NoReturn

import numpy as np

from fewview.errors import FormatError

_PLAIN = frozenset("?bBhHiIlLqQefdSU")  # kinds of numbers and of text, none of objects or fields
_MODULES = {"numpy.core.multiarray", "numpy._core.multiarray"}


def load(data: bytes, what: str) -> Any:
    """Return what a pickle holds.

    Parameters
    ----------
    what
        Names the file in errors.

    Raises
    ------
    FormatError
        If it is broken or holds anything but arrays, numbers, text and containers of them.
    """
    try:
        return _plain(_Unpickler(io.BytesIO(data)).load())
    except FormatError as error:
        raise FormatError(f"{error}", place=what) from None
    except Exception as error:  # noqa: BLE001 (a broken pickle raises anything)
        raise FormatError(
            f"a broken pickle ({type(error).__name__}: {error})", place=what
        ) from None


class _Kind:
    """Replaces ``numpy.dtype``: the text of a plain one."""

    def __init__(self, text: Any, *_: Any) -> None:
        text = text.decode("ascii") if isinstance(text, bytes) else str(text)
        self.text, self.objects = text, text.lstrip("|=<>") in {"O", "O8"}
        if not self.objects and np.dtype(text).char not in _PLAIN:
            raise FormatError(f"an array of {text!r} is not read")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        if state[2] is not None or state[3] is not None:
            raise FormatError("arrays with fields are not read")
        order = state[1].decode("ascii") if isinstance(state[1], bytes) else state[1]
        if order in ("<", ">") and not self.objects:
            self.text = order + self.text.lstrip("|=<>")


class _Array:
    """Replaces an array that is being read."""

    value: Any = None

    def __init__(self, *_: Any) -> None:
        """Take what ``_reconstruct`` is called with: a type and an empty shape, of no use."""

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, kind, in_columns, data = state
        if kind.objects:
            flat = np.empty(len(data), object)
            flat[:] = data
        else:
            data = data.encode("latin-1") if isinstance(data, str) else data
            flat = np.frombuffer(data, kind.text)
        self.value = flat.reshape(shape, order="F" if in_columns else "C")


def _from_buffer(data: Any, kind: _Kind, shape: tuple[int, ...], order: str) -> _Array:
    array = _Array()
    array.__setstate__((1, shape, kind, order == "F", bytes(data)))
    return array


def _scalar(kind: _Kind, data: Any) -> Any:
    if isinstance(data, str):
        data = data.encode("latin-1")
    return np.frombuffer(data, kind.text)[0].item()


def _encode(text: str, encoding: str = "latin1") -> bytes:
    return text.encode("latin-1" if encoding.startswith("latin") else "utf-8")


def _type_alone(*_: Any) -> NoReturn:
    raise FormatError("the pickle calls numpy.ndarray; only whole arrays are read")


_KNOWN: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _type_alone,
    ("numpy", "dtype"): _Kind,
    ("_codecs", "encode"): _encode,
    ("numpy.core.numeric", "_frombuffer"): _from_buffer,
    ("numpy._core.numeric", "_frombuffer"): _from_buffer,
    **{(module, "_reconstruct"): _Array for module in _MODULES},
    **{(module, "scalar"): _scalar for module in _MODULES},
    ("collections", "OrderedDict"): dict,
    ("builtins", "set"): set,
    ("__builtin__", "set"): set,
}


class _Unpickler(pickle.Unpickler):  # its `find_class` is what could run anything
    def find_class(self, module: str, name: str) -> Any:
        """Return a stand-in of the few things that arrays are made of; refuse all others."""
        try:
            return _KNOWN[module, name]
        except KeyError:
            raise FormatError(
                f"the pickle names {module}.{name}; only arrays and plain containers are read"
            ) from None

    def persistent_load(self, pid: Any) -> NoReturn:
        """Refuse objects that are elsewhere."""
        raise FormatError(f"the pickle refers to {pid!r} outside it")


def _plain(value: Any) -> Any:
    """Return the arrays and containers in place of what stood for them."""
    if isinstance(value, _Array):
        return value.value if value.value is None else _unwrapped(value.value)
    if isinstance(value, dict):
        return {_plain(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set):
        return type(value)([_plain(item) for item in value])
    if value is None or isinstance(value, int | float | str | bytes):
        return value
    raise FormatError(f"the pickle holds a {type(value).__name__}")


def _unwrapped(array: Any) -> Any:
    if array.dtype != object:
        return array
    for index in np.ndindex(array.shape):
        array[index] = _plain(array[index])
    return array
