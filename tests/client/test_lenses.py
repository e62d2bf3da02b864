"""Lenses as people write them."""

from typing import Any

import pytest
from fewview.lenses import lenses_in

from models.settings.lenses import Lens

NAMES = ["cam1", "cam 2", "top"]


@pytest.mark.parametrize(
    ("text", "lenses"),
    [
        ("26mm", [{"equivalent": 26}]),
        ("fov:78.5", [{"field_of_view": 78.5, "axis": "horizontal"}]),
        ("vfov:50±10%", [{"field_of_view": 50, "axis": "vertical", "sd": 0.1}]),
        ("1460px+-2%", [{"focal": 1460, "sd": 0.02}]),
        (
            "cam1=dfov:120, top=26mm",
            [{"field_of_view": 120, "axis": "diagonal"}, None, {"equivalent": 26}],
        ),
        ("cam 2=same:top,2=26mm +-5%", [None, {"same_as": 2}, {"equivalent": 26, "sd": 0.05}]),
    ],
)
def test_what_is_known_is_read(text: str, lenses: list[Any]) -> None:
    found = lenses_in(text, NAMES)
    assert found == lenses
    for lens in found:
        assert lens is None or Lens.model_validate(lens)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected one of 26mm"),
        ("26", "expected one of 26mm"),
        ("26mm,24mm", "expected VIEW=VALUE"),
        ("cam9=26mm", "no view 'cam9'; there are: cam1, cam 2, top"),
        ("cam1=26mm,0=24mm", "has two lenses"),
        ("same:cam3", "no view 'cam3'"),
        ("26mm+-5%x", "expected one of"),
        ("cam1=fov:wide", "expected one of"),
    ],
)
def test_what_cannot_be_read_is_answered_with_what_can(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        lenses_in(text, NAMES)
