"""The JSON form of what was noticed, which everything that can be noticed of shares."""

from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from models.findings.finding import Finding
from models.findings.remedies import REMEDY_FIELDS, RemedyField


def _fields_of(known: dict[str, Any]) -> tuple[RemedyField, ...]:
    return REMEDY_FIELDS.get(known["code"], ()) if "code" in known else ()


class FindingForm(Finding):
    """Something that was noticed, and what to do about it.

    An empty list of views, frames or keypoints means that the finding is about all of them.
    """

    remedy_fields: tuple[RemedyField, ...] = Field(
        default_factory=_fields_of,
        description="The fields in which the remedy can be given, by their names in this API;"
        " docs/findings.md has their places.",
    )


def _as_data(found: Any) -> Any:
    """Return findings as plain data, from which their form is made; anything else as it is."""
    if not isinstance(found, list | tuple):
        return found
    return [each.model_dump() if isinstance(each, Finding) else each for each in found]


Findings = Annotated[
    list[FindingForm],
    BeforeValidator(_as_data),
    Field(description="What was noticed, and what to do about it: docs/findings.md has all codes."),
]
EXAMPLE_FINDINGS: Any = [
    FindingForm.of(
        "keypoint_frozen", views=[1], keypoints=[3], frames=range(300, 421), x=5, y=5, share=0.04
    ).model_dump(mode="json")
]
