"""Mechanisms can be switched off: what they replace is there, and comes back."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.ablation import EVERYTHING, Row, gains
from benchmarks.mechanisms import MECHANISMS
from benchmarks.switching import GEOMETRY, LIFT, Mechanism, Part, observed, place_of
from models.capture import checks
from models.settings.config import FitConfig

KEYPOINTS = np.zeros((2, 2, 5, 2), np.float32)
MODELS = Path(__file__).parents[2] / "models"


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_what_a_mechanism_replaces_is_there_and_comes_back(mechanism: Mechanism) -> None:
    assert mechanism.parts or mechanism.settings
    assert set(dict(mechanism.settings)) <= set(FitConfig.model_fields)
    assert all((MODELS / file).is_file() for file in mechanism.files)
    places = [place_of(part) for part in mechanism.parts]
    before = [vars(owner)[name] for owner, name in places]
    with mechanism.off():
        assert [vars(owner)[name] for owner, name in places] == [p.instead for p in mechanism.parts]
    assert [vars(owner)[name] for owner, name in places] == before


def test_a_mechanism_acts_where_it_answers_otherwise_than_what_replaces_it() -> None:
    for instead, acts in ((checks.observed, set()), (lambda *_: None, {"a"})):
        part = Part("models.capture.checks", "observed", instead)
        with observed([Mechanism("a", GEOMETRY, (), (part,))]) as acting:
            checks.observed(KEYPOINTS, None)
        assert acting == acts


def test_gains_count_captures_on_which_a_mechanism_does_not_act() -> None:
    name = MECHANISMS[0].name
    nan = float("nan")
    rows = [
        Row("setting", number, "setting pair", LIFT, which, acts, twice, nan, nan, 1.0)
        for number, which, acts, twice in (
            ("0", EVERYTHING, True, 0.0095),
            ("0", name, True, 0.0195),
            ("1", EVERYTHING, True, 0.0095),
            ("1", name, False, 0.0095),
        )
    ]
    (found,) = gains(rows)
    assert found["acts in"] == "1 of 2"
    assert found["setting pair"] == "34.7"  # half of log 2
