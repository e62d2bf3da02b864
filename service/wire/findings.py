"""The JSON form of what was noticed, which everything that can be noticed of shares."""

from typing import Annotated, Any

from pydantic import Field

from models.findings.finding import Finding

Findings = Annotated[
    list[Finding],
    Field(description="What was noticed, and what to do about it: docs/findings.md has all codes."),
]
EXAMPLE_FINDINGS: Any = [
    Finding.of(
        "keypoint_frozen", views=[1], keypoints=[3], frames=range(300, 421), x=5, y=5, share=0.04
    ).model_dump(mode="json")
]
