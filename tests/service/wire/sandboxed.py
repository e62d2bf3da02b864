"""Work that is done in the sandbox; it imports little, as the sandbox does before each test."""

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from service.wire.sandbox import LONGEST_ANSWER

LIES: dict[str, tuple[Any, dict[str, Any]]] = {
    "an array of more bytes than it may take": ({}, {"a": np.broadcast_to(np.float32(0), 2**40)}),
    "arrays that together are too much": ({}, {n: np.zeros(200_000, np.float32) for n in "ab"}),
    "a long text": ({"text": "x" * LONGEST_ANSWER}, {}),
    "no answer": ([1], {}),
    "an array of objects": ({}, {"a": np.array(["x"])}),
}


def work(asked: dict[str, Any], data: bytearray) -> tuple[Any, dict[str, Any]]:
    """Answer as asked; this runs in the process that is not trusted."""
    if "lie" in asked:
        return LIES[asked["lie"]]
    time.sleep(asked.get("seconds", 0))
    if "memory" in asked:
        bytearray(asked["memory"])
    if "file" in asked:
        Path("made").write_bytes(bytes(asked["file"]))
    answer = {"came": len(data), "environment": dict(os.environ)}
    return answer, {"a": np.arange(3, dtype=np.float32)}
