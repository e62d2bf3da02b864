"""What may be relied on, by what was noticed."""

import pytest

from models.findings.catalogue import CATALOGUE, FindingCode
from models.findings.finding import Finding
from models.findings.verdict import GOOD, SERIOUS, verdict_of


def test_without_a_warning_a_result_is_good() -> None:
    assert verdict_of([]).reliable == GOOD
    known = verdict_of([Finding.of("left_right_mended"), Finding.of("views_opposite")])
    assert (known.level, known.code, known.remedy) == ("good", None, "")


@pytest.mark.parametrize("code", [code for code, entry in CATALOGUE.items()])
def test_no_warning_is_good_and_its_remedy_is_what_helps(code: FindingCode) -> None:
    verdict = verdict_of([Finding.of(code)])
    if CATALOGUE[code].severity == "info":
        assert verdict.level == "good"
        return
    assert verdict.level == ("serious" if code in SERIOUS else "caution")
    assert (verdict.code, verdict.remedy) == (code, CATALOGUE[code].remedy)
    assert verdict.reliable.startswith("Rely on")


def test_the_worst_finding_decides_whatever_comes_first() -> None:
    found = [Finding.of("noise_high"), Finding.of("one_view"), Finding.of("cameras_not_found")]
    assert verdict_of(found).code == verdict_of(found[::-1]).code == "cameras_not_found"
    assert {code for code in SERIOUS if CATALOGUE[code].severity != "warning"} == set()
