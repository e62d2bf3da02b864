"""Reading untrusted JSON and pickles as plain data, within bounds.

No pickle is unpickled. Its operations are walked, and those that make plain data are executed here.
So nothing is imported or called, no memory is allocated for a claimed length, and only text is
hashed, for which collisions cannot be prepared.
"""

import json
import pickletools
from collections.abc import Callable, Iterable
from typing import Any

MAX_BYTES = 2**20  # of JSON or of a pickle; the largest fit that can be asked for takes a tenth
MAX_OPERATIONS = 2**18  # of a pickle
MAX_SIZE = 2**21  # of a value, each part counted as often as it is met
SIZE_OF_VALUE = 16  # beside the characters of a text
MAX_DEPTH = 100
MAX_BITS = 1024  # of an integer


def loads(data: bytes) -> Any:
    """Return the plain data that JSON or a pickle holds: text, numbers, lists, dictionaries, ...

    Raises
    ------
    ValueError
        If it is broken, holds anything else, or exceeds a bound of this module.
    """
    if len(data) > MAX_BYTES:
        raise ValueError(f"expected {MAX_BYTES} bytes at most, got {len(data)}")
    is_json = data[:1] in (b"[", b"{", b'"')  # a pickle starts otherwise
    try:
        value = json.loads(data) if is_json else _read_pickle(data)
    except RecursionError:
        raise ValueError(f"nested more than {MAX_DEPTH} deep") from None
    except (IndexError, KeyError, OverflowError) as error:
        raise ValueError(f"a broken pickle ({type(error).__name__})") from None
    _check(value)
    return value


def _check(value: Any) -> None:
    """Raise ``ValueError`` if a value is too large, too deep, or holds too long an integer."""
    pending = [(value, 1)]
    size = SIZE_OF_VALUE
    while pending:
        item, depth = pending.pop()
        if isinstance(item, int) and item.bit_length() > MAX_BITS:
            raise ValueError(f"an integer of more than {MAX_BITS} bits")
        if isinstance(item, str | bytes):
            size += len(item)
        parts: Iterable[Any] = ()
        if isinstance(item, dict):
            size += 2 * SIZE_OF_VALUE * len(item)
            parts = (part for pair in item.items() for part in pair)
        elif isinstance(item, list | tuple):
            size += SIZE_OF_VALUE * len(item)
            parts = item
        if size > MAX_SIZE:
            raise ValueError(f"larger than {MAX_SIZE} bytes once shared parts are written out")
        if depth > MAX_DEPTH:
            raise ValueError(f"nested more than {MAX_DEPTH} deep")
        pending.extend((part, depth + 1) for part in parts)


class _Stack:
    """What a pickle works on: values, marks among them, and values that are noted for later."""

    def __init__(self) -> None:
        self.values: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def take(self, count: int | None = None) -> list[Any]:
        """Take the last values: so many, or those since the last mark."""
        at = self.marks.pop() if count is None else len(self.values) - count
        if at < 0:
            raise IndexError
        taken = self.values[at:]
        del self.values[at:]
        return taken

    def mark(self) -> None:
        """Mark this place."""
        self.marks.append(len(self.values))

    def note(self, place: int) -> None:
        """Note the last value; a pickler counts the places."""
        if not 0 <= place <= MAX_OPERATIONS:
            raise IndexError
        self.memo[place] = self.values[-1]

    def extend(self, count: int | None) -> None:
        """Append the last values to the list before them."""
        items = self.take(count)
        _expect(self.values[-1], list).extend(items)

    def fill(self, count: int | None) -> None:
        """Put the last values, keys and what they lead to, into the dictionary before them."""
        items = self.take(count)
        _filled(_expect(self.values[-1], dict), items)


_Operation = Callable[[_Stack, Any], Any]
_GIVEN = (  # operations whose argument is a value
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
    *("STRING", "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8"),
    *("UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"),
)
_MAKE_A_VALUE: dict[str, _Operation] = {
    **dict.fromkeys(_GIVEN, lambda _, argument: argument),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), lambda stack, place: stack.memo[place]),
    "NONE": lambda *_: None,
    "NEWTRUE": lambda *_: True,
    "NEWFALSE": lambda *_: False,
    "EMPTY_TUPLE": lambda *_: (),
    "EMPTY_LIST": lambda *_: [],
    "EMPTY_DICT": lambda *_: {},
    "TUPLE1": lambda stack, _: tuple(stack.take(1)),
    "TUPLE2": lambda stack, _: tuple(stack.take(2)),
    "TUPLE3": lambda stack, _: tuple(stack.take(3)),
    "TUPLE": lambda stack, _: tuple(stack.take()),
    "LIST": lambda stack, _: stack.take(),
    "DICT": lambda stack, _: _filled({}, stack.take()),
}
_CHANGE_THE_STACK: dict[str, _Operation] = {
    **dict.fromkeys(("PROTO", "FRAME"), lambda *_: None),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT"), lambda stack, place: stack.note(place)),
    "MEMOIZE": lambda stack, _: stack.note(len(stack.memo)),
    "MARK": lambda stack, _: stack.mark(),
    "APPEND": lambda stack, _: stack.extend(1),
    "APPENDS": lambda stack, _: stack.extend(None),
    "SETITEM": lambda stack, _: stack.fill(2),
    "SETITEMS": lambda stack, _: stack.fill(None),
}


def _read_pickle(data: bytes) -> Any:
    """Carry out the operations of a pickle that make plain data (``pickletools`` explains them)."""
    stack = _Stack()
    for number, (operation, argument, _) in enumerate(pickletools.genops(data)):
        name = operation.name
        if number > MAX_OPERATIONS:
            raise ValueError(f"a pickle of more than {MAX_OPERATIONS} operations")
        if name == "STOP":
            return stack.values.pop()
        if name in _MAKE_A_VALUE:
            stack.values.append(_MAKE_A_VALUE[name](stack, argument))
        elif name in _CHANGE_THE_STACK:
            _CHANGE_THE_STACK[name](stack, argument)
        elif name == "STACK_GLOBAL":
            raise _not_plain(".".join(str(part)[:100] for part in stack.take(2)))
        else:
            raise _not_plain(str(argument or name).replace(" ", "."))
    raise ValueError("a pickle without an end")


def _not_plain(what: str) -> ValueError:
    return ValueError(f"A job's arguments must be plain data; this one holds {what[:200]}.")


def _expect(value: Any, kind: type) -> Any:
    if type(value) is not kind:
        raise ValueError(f"a broken pickle: a {type(value).__name__} is no {kind.__name__}")
    return value


def _filled(made: dict[Any, Any], items: list[Any]) -> dict[Any, Any]:
    for key, value in zip(items[::2], items[1::2], strict=True):
        if not isinstance(key, str):
            raise ValueError("a dictionary whose keys are not text")
        made[key] = value
    return made
