"""What may be relied on of a result, in one sentence that all who show it share."""

from collections.abc import Sequence
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field
from typing_extensions import TypeAliasType

from models.findings.catalogue import FindingCode
from models.findings.finding import Finding

Level = TypeAliasType("Level", Literal["good", "caution", "serious"])

# Findings after which a result is not what it seems to be, the worst first, and what is left of it.
SERIOUS: dict[FindingCode, str] = {
    "views_identical": "Rely on nothing in depth: two views are one and the same.",
    "coordinates_normalised": "Rely on no length, depth or lens: the keypoints are not pixels.",
    "cameras_not_found": "Rely on what each view shows, not on depth: no cameras were found.",
    "lenses_extreme": "Rely on what each view shows, not on depths and lengths: no real lens is"
    " like those that were estimated.",
    "one_view": "Rely on what the view shows; depth follows from the shapes alone.",
    "rig_declared_but_moving": "Rely on angles at most, not on places in the room: the cameras"
    " moved.",
    "left_right_swapped": "Rely on the trunk at most: a view has left and right exchanged.",
    "handedness_not_observable": "Rely on lengths and angles; the structures may be their mirror"
    " images.",
    "too_few_frames": "Rely on keypoints that several views show; hidden ones are guesses.",
    "no_motion": "Rely on what each view shows; cameras and depth are uncertain.",
}
GOOD = "Nothing was noticed that limits what may be relied on."


class Verdict(BaseModel):
    """What may be relied on of a result, by the finding that weighs most."""

    model_config = ConfigDict(frozen=True)

    level: Level = Field(
        description="`good`: no finding limits the result. `caution`: it is less certain in"
        " places. `serious`: it is not what it seems to be."
    )
    code: FindingCode | None = Field(description="The finding that decides; null if it is good.")
    reliable: str = Field(description="What may be relied on, in a sentence.")
    remedy: str = Field(description="What would help most; empty if it is good.")
    expected: str | None = Field(
        None,
        description="How far points are expected to be off, which frames are doubtful and where one"
        " more camera would help, in sentences; null where there is no report.",
    )


def verdict_of(findings: Sequence[Finding], expected: str | None = None) -> Verdict:
    """Return the verdict on a result of which this was noticed, and whose report is so worded."""
    return _by_findings(findings).model_copy(update={"expected": expected})


def _by_findings(findings: Sequence[Finding]) -> Verdict:
    warnings = {finding.code: finding for finding in findings if finding.severity == "warning"}
    for code, reliable in SERIOUS.items():
        if code in warnings:
            remedy = warnings[code].remedy
            return Verdict(level="serious", code=code, reliable=reliable, remedy=remedy)
    for code, finding in warnings.items():
        reliable = f"Rely on it but for this: {finding.effect[0].lower()}{finding.effect[1:]}"
        return Verdict(level="caution", code=code, reliable=reliable, remedy=finding.remedy)
    return Verdict(level="good", code=None, reliable=GOOD, remedy="")
