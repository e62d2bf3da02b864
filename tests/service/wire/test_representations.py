"""Arrays on their way out."""

import io
import time

import numpy as np
import pytest

from service.wire import arrays


def test_an_npz_written_later_has_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    found = {"a": np.arange(6.0).reshape(2, 3), "b": np.zeros((0, 2), np.float32)}
    now = arrays.to_npz(found)
    later = time.localtime(time.time() + 1000)
    monkeypatch.setattr(time, "localtime", lambda *_: later)
    assert arrays.to_npz(found) == now
    with np.load(io.BytesIO(now)) as file:
        assert all((file[name] == array).all() for name, array in found.items())
