"""Constants are found where they are named, and change wherever they are read."""

import numpy as np
import pytest

from benchmarks.constants import FAILS, Row, by_folder, moving_nothing
from benchmarks.found_constants import DOUBLE, HALF, constants, read_constants, set_to
from models.bundle import bone_lengths
from models.capture import checks
from models.capture.clocks import positions_in_step
from models.numerics import tiny

CONSTANTS = {(one.module, one.name): one for one in constants()}
TINY = CONSTANTS["models.numerics.tiny", "TINY"]
LEAST_FRAMES = CONSTANTS["models.capture.checks", "LEAST_FRAMES"]


def test_a_constant_changes_in_all_that_read_it_and_comes_back() -> None:
    before = LEAST_FRAMES.changed(1.0), checks.LEAST_FRAMES
    with set_to([(LEAST_FRAMES, LEAST_FRAMES.changed(DOUBLE)), (TINY, 1.0)]):
        assert 2 * before[1] == checks.LEAST_FRAMES
        assert vars(bone_lengths)["TINY"] == tiny.TINY == 1.0
    assert before == (None, checks.LEAST_FRAMES)
    assert vars(bone_lengths)["TINY"] == tiny.TINY == 1e-12


@pytest.mark.parametrize(
    ("value", "half", "double"),
    [(3.0, 1.5, 6.0), (0.9, 0.95, 0.8), (5, 2, 10), (1, None, 2), (0, None, None)],
)
def test_halves_and_doubles(
    value: float, half: float | None, double: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checks, "MARGIN", value)
    margin = CONSTANTS["models.capture.checks", "MARGIN"]
    for factor, expected in ((HALF, half), (DOUBLE, double)):
        assert margin.changed(factor) == (None if expected is None else pytest.approx(expected))


def test_constants_of_compiled_functions_and_defaults_are_not_asked() -> None:
    assert TINY.fixed == "compiled"
    assert LEAST_FRAMES.fixed == ""
    assert {one.fixed for one in CONSTANTS.values()} == {"", "compiled", "bound"}


def test_what_code_reads_that_runs() -> None:
    with read_constants(list(CONSTANTS.values())) as found:
        pass
    assert not found
    with read_constants(list(CONSTANTS.values())) as found:
        positions_in_step(np.arange(12.0).reshape(6, 2))
    assert ("models.capture.clocks", "WHOLE") in found
    assert ("models.capture.clocks", "EVEN") not in found


def test_what_moves_errors_alone_moves_something() -> None:
    margin, pixels = "capture.checks.MARGIN", "capture.checks.PIXELS"
    rows = [
        Row("setting", 2, False, HALF, (margin, pixels), FAILS, False),
        Row("setting", 2, False, HALF, (margin,), FAILS, True),
        Row("setting", 2, False, HALF, (pixels,), 0.0, True),
    ]
    assert list(moving_nothing(rows)) == [f"{pixels} (1)"]
    (capture,) = [row for row in by_folder(rows) if row["folder"] == "capture"]
    assert (capture["move errors"], capture["move nothing"]) == (1, 1)
