"""What was wrong with single views' pixels, in words."""

from typing import get_args

from fewview.commands.talking import findings_in
from fewview.mended import WORDS, mended_in_words

from models.findings.catalogue import CauseCode


def test_each_cause_has_words_and_nothing_else() -> None:
    assert set(WORDS) == set(get_args(CauseCode.__value__))
    for code in WORDS:
        assert mended_in_words({"code": code, "views": [1]}, ["left", "right"])
    assert mended_in_words({"code": "outliers", "views": [1]}) is None


def test_words_have_the_view_the_numbers_and_whether_it_was_undone() -> None:
    numbers = {"x": 559.6, "x_sd": 3.0, "y": 180.2, "applied": 1.0}
    cropped = {"code": "view_cropped", "views": [1], "evidence": numbers}
    names = ["cam1", "cam2"]
    assert list(findings_in({"findings": [cropped]}, names)) == [mended_in_words(cropped, names)]
    assert mended_in_words(cropped, names) == "cam2: counted from (560, 180); put right"
    assert mended_in_words(cropped | {"evidence": numbers | {"applied": 0.0}}, names) == (
        "cam2: counted from (560, 180); not undone"
    )
    padded = {"code": "view_padded", "views": [0], "evidence": {"fx_over_fy": 1.7777}}
    assert mended_in_words(padded) == "view0: padded to another shape, x by 1.78 of y; not undone"
