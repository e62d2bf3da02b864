"""What a process that reads a body answers is not trusted: the body may have taken it over."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from service.wire.forks import LONGEST_ANSWER, EndedError, Forks

LIES: dict[str, tuple[Any, dict[str, Any]]] = {
    "an array of more bytes than it may take": ({}, {"a": np.broadcast_to(np.float32(0), 2**40)}),
    "arrays that together are too much": ({}, {n: np.zeros(200_000, np.float32) for n in "ab"}),
    "a long text": ({"text": "x" * LONGEST_ANSWER}, {}),
    "no answer": ([1], {}),
    "an array of objects": ({}, {"a": np.array(["x"])}),
}


def work(asked: dict[str, Any], data: bytearray) -> tuple[Any, dict[str, Any]]:
    """Answer as asked; this runs in the process that is not trusted."""
    if asked["lie"] is None:
        return {"came": len(data)}, {"a": np.arange(3, dtype=np.float32)}
    return LIES[asked["lie"]]


@pytest.fixture(scope="module")
def forks() -> Iterator[Forks]:
    made = Forks(__name__)
    yield made
    made._running().stop()


@pytest.mark.parametrize("lie", LIES)
def test_an_answer_of_more_than_may_come_is_none(forks: Forks, lie: str) -> None:
    with pytest.raises(EndedError):
        forks.work(__name__, {"lie": lie}, b"", max_bytes=2**20)
    answer, arrays = forks.work(__name__, {"lie": None}, b"abc", max_bytes=2**20)
    assert answer == {"came": 3}
    assert arrays["a"].tolist() == [0, 1, 2]
