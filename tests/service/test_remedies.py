"""Every remedy of a finding that names a field can be taken: over HTTP, by command, on the page."""

import json
import re
from functools import cache
from pathlib import Path
from typing import Any, get_args

from fewview.commands.reading import OPTIONS

from models.findings.catalogue import CATALOGUE, LiftCode
from models.findings.remedies import REMEDY_FIELDS, RemedyField
from service.openapi import document
from service.wire.detector_files import DetectorReading

ROOT = Path(__file__).parents[2]
READING = ROOT / "page" / "src" / "remedies" / "reading.tsx"
REGISTRY = ROOT / "page" / "src" / "remedies" / "registry.ts"
FRAME_FINDINGS = ROOT / "page" / "src" / "science" / "frame_findings.ts"
OF_LIFTS = {"frame", "refine", "views"}
OPTION = {"image_sizes": "image_size"}


@cache
def fields(schema: str) -> frozenset[str]:
    return frozenset(json.loads(document())["components"]["schemas"][schema]["properties"])


def places() -> dict[str, frozenset[str]]:
    """Return which fields each form of the API has."""
    names = ("DatasetChange", "DatasetCreateForm", "FitConfig", "FitCreate", "LiftCreate")
    return {name: fields(name) for name in names}


def test_a_remedy_lists_the_fields_that_it_names() -> None:
    known = frozenset[str]().union(*places().values()) - {"name", "keypoints", "frame"}
    # `times` come with the frames, and `synchronise` is `auto` unless somebody turned it off.
    known -= {"times", "synchronise"}
    for code, entry in CATALOGUE.items():
        words = re.findall(r"`(\w+)[:`]", entry.remedy)
        named = [word for word in words if word in known]
        missing = [word for word in named if word not in REMEDY_FIELDS.get(code, ())]
        assert not missing, f"{code}: {missing} are named, and not in its fields"


def test_every_field_of_a_remedy_is_in_the_api() -> None:
    all_places = places()
    for field in get_args(RemedyField.__value__):
        found = [name for name, has in all_places.items() if field in has]
        assert found, f"no form of the API has {field}"
    used = {field for named in REMEDY_FIELDS.values() for field in named}
    assert used == set(get_args(RemedyField.__value__))


def test_every_field_of_a_remedy_has_an_option_or_is_a_fit_s() -> None:
    of_fits: frozenset[Any] = fields("FitConfig") | {"from_model"}  # `fewview fit -c`, --from-model
    for field in set(get_args(RemedyField.__value__)) - of_fits - OF_LIFTS:
        assert OPTION.get(field, field) in OPTIONS, field


def test_every_field_of_a_remedy_has_a_control_on_the_page() -> None:
    text = REGISTRY.read_text()
    registered = set(
        re.findall(r"^  (\w+): \{", text[text.index("const REMEDIES") :], re.MULTILINE)
    )
    assert registered == set(get_args(RemedyField.__value__))


def test_what_the_page_notices_of_frames_has_the_remedies_of_the_service() -> None:
    found = re.findall(
        r'code: "(\w+)".*?remedy_fields: \[(.*?)\]', FRAME_FINDINGS.read_text(), re.DOTALL
    )
    assert len(found) == len(get_args(LiftCode.__value__))
    for code, fields in found:
        assert tuple(re.findall(r"\w+", fields)) == REMEDY_FIELDS.get(code, ()), code


def test_every_option_of_reading_has_a_control_on_the_page() -> None:
    text = READING.read_text()
    options = text[text.index("export const READING") : text.index("\n};")]
    registered = set(re.findall(r"^  (\w+): \{", options, re.MULTILINE))
    assert registered == set(DetectorReading.model_fields)
