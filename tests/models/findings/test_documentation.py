"""docs/findings.md describes every code as the catalogue does."""

from pathlib import Path
from typing import get_args

from models.findings.catalogue import CATALOGUE, CameraCode, CaptureCode, CauseCode, LiftCode

PAGE = Path(__file__).parents[3] / "docs" / "findings.md"
GROUPS = {
    "## Of keypoints": CaptureCode,
    "## Of cameras": CameraCode,
    "## Of one view's pixels": CauseCode,
    "## Of lifts": LiftCode,
}


def catalogue() -> str:
    """Return the tables of all codes."""
    lines = []
    for title, group in GROUPS.items():
        lines += [title, "", "| code | effect | remedy |", "|---|---|---|"]
        for code in get_args(group.__value__):
            severity, effect, remedy = CATALOGUE[code]
            mark = " *info*" if severity == "info" else ""
            lines.append(f"| `{code}`{mark} | {effect} | {remedy} |")
        lines.append("")
    return "\n".join(lines)


def test_every_code_is_documented_in_the_words_of_the_catalogue() -> None:
    assert PAGE.read_text().endswith(f"\n{catalogue()}")
