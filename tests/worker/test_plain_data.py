"""Jobs are read as plain data: all that picklers write of it, and nothing that takes more."""

import json
import pickle
import struct
import tracemalloc
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from worker.plain_data import loads

MOST_MEMORY = 100 * 2**20  # bytes, for whatever a job may hold
PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**1000), 2**1000)
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary(),
    lambda inner: (
        st.lists(inner, max_size=5)
        | st.lists(inner, max_size=5).map(tuple)
        | st.dictionaries(st.text(), inner, max_size=5)
    ),
)


@settings(suppress_health_check=[HealthCheck.too_slow])  # examples are made beside other tests
@given(value=PLAIN, protocol=st.integers(0, pickle.HIGHEST_PROTOCOL), shared=st.booleans())
def test_all_that_a_pickler_writes_of_plain_data_is_read(
    value: Any, protocol: int, shared: bool
) -> None:
    if protocol < 3:  # which has no operation for bytes: they name a function
        value = json.loads(json.dumps(value, default=lambda _: "bytes"))
    value = [value, {"again": value}] if shared else value
    assert loads(pickle.dumps(value, protocol)) == value


def shared(levels: int, width: int) -> Any:
    value: Any = ["x" * 50] * width
    for _ in range(levels):
        value = [value] * width
    return value


def deep(levels: int, kind: type = list) -> Any:
    value: Any = kind()
    for _ in range(levels):
        value = kind([value])
    return value


def circular() -> list[Any]:
    value: list[Any] = []
    value.append(value)
    return value


def key_of_tuples(levels: int, opening: bytes) -> bytes:
    """Return a pickle of a dictionary whose key takes 2 ** levels steps to hash, or as deep."""
    return b"}" + b")" + opening * levels + b"Ns."


BOMBS = {
    "a place that sets a gigabyte aside": b"\x80\x04Nr\xff\xff\xff\x07.",
    "the same as text": b"Np134217728\n.",
    "text of a claimed length": b"\x8d" + struct.pack("<Q", 2**33) + b"x.",
    "bytes of a claimed length": b"\x8e" + struct.pack("<Q", 2**62) + b"x.",
    "an array of a claimed length": b"\x96" + struct.pack("<Q", 2**33) + b"x.",
    "an integer of a claimed length": b"\x8b" + struct.pack("<i", 2**31 - 1) + b"x.",
    "a frame of a claimed length": b"\x80\x04\x95" + struct.pack("<Q", 2**40) + b"N",
    "lists within lists": pickle.dumps(shared(6, 10)),
    "one text often": pickle.dumps(["x" * 500_000] * 1000),
    "a long integer": pickle.dumps(10**5000),
    "a long integer as text": b"I" + b"9" * 5000 + b"\n.",
    "a longer integer as text": b"L" + b"9" * 900_000 + b"L\n.",
    "a long integer in JSON": b'{"a": ' + b"9" * 5000 + b"}",
    "3000 lists": b"]" * 3000 + b"a" * 2999 + b".",
    "3000 tuples": b")" + b"\x85" * 3000 + b".",
    "3000 lists in JSON": b"[" * 3000 + b"]" * 3000,
    "500 lists in JSON": json.dumps(deep(500)).encode(),
    "itself": pickle.dumps(circular()),
    "a key that takes years to hash": key_of_tuples(60, b"2\x86"),
    "a key that is too deep to hash": key_of_tuples(900_000, b"\x85"),
    "keys that collide": b"}("
    + b"".join(b"L%dL\nN" % (number * (2**61 - 1)) for number in range(40_000))
    + b"u.",
    "places that collide": b"N"
    + b"".join(b"p%d\n" % (number * (2**61 - 1)) for number in range(40_000))
    + b".",
    "many operations": b"N0" * 500_000 + b".",
    "many values": b"(" + b"N" * 1_000_000 + b"t.",
    "many dictionaries": b"]" + b"}a" * 500_000 + b".",
    "many values in JSON": b"[" + b"[]," * 300_000 + b"1]",
    "too much": pickle.dumps("x" * 2**21),
    "nothing": b"",
    "no end": b"N",
    "an empty stack": b".",
    "no such operation": b"\xff",
    "a mark too few": b"t.",
    "a list that is none": b"NNa.",
    "a function": b"cos\nsystem\n(S'true'\ntR.",
    "a function of a later protocol": b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x04true\x85R.",
    "an instance": b"(S'true'\nios\nsystem\n.",
    "something of the outside": b"Pname\n.",
    "a set": pickle.dumps({1}),
}


@pytest.mark.parametrize("name", list(BOMBS))
def test_nothing_else_is_read_and_no_memory_is_spent_on_it(name: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"."):
            loads(BOMBS[name])
        assert tracemalloc.get_traced_memory()[1] < MOST_MEMORY
    finally:
        tracemalloc.stop()


def test_the_largest_jobs_are_read() -> None:
    metadata = {f"subject {number}": ["x" * 100] * 5 for number in range(100)}
    for data in (pickle.dumps(metadata), json.dumps(metadata).encode()):
        assert loads(data) == metadata
    assert loads(json.dumps(deep(98)).encode()) == deep(98)
