"""What was wrong with single views' pixels, in words: findings that `mend: auto` undoes."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

Numbers = Mapping[str, float]


def _sides(numbers: Numbers) -> str:
    return ", with left and right exchanged" if numbers.get("sides_exchanged") else ""


def _shape(numbers: Numbers) -> str:
    return f", x by {numbers['fx_over_fy']:.3g} of y" if "fx_over_fy" in numbers else ""


WORDS: dict[str, Callable[[Numbers], str]] = {
    "view_cropped": lambda n: f"counted from ({n.get('x', 0):.0f}, {n.get('y', 0):.0f})",
    "view_padded": lambda n: f"padded to another shape{_shape(n)}",
    "view_scaled": lambda n: f"found on an image of {n.get('scale', 1):.3g} times the size",
    "view_stretched": lambda n: f"stretched{_shape(n)}",
    "view_mirrored": lambda n: f"mirrored{_sides(n)}",
    "view_turned": lambda n: f"turned by {n.get('degrees', 180):.0f} degrees",
    "axes_exchanged": lambda _: "x and y exchanged",
}


def put_right(finding: Mapping[str, Any]) -> bool:
    """Whether a finding is of such a cause, and the fit has undone it."""
    return finding["code"] in WORDS and bool((finding.get("evidence") or {}).get("applied"))


def mended_in_words(finding: Mapping[str, Any], names: Sequence[str] | None = None) -> str | None:
    """Return what was wrong with a view, and whether the fit undid it; None if it is no such cause.

    `finding` is as the service sends it, `names` are those of all views, such as of the dataset:
    ``cam2: counted from (560, 180); put right``.
    """
    words, numbers = WORDS.get(finding["code"]), finding.get("evidence") or {}
    if words is None:
        return None
    views = [
        names[view] if names and view < len(names) else f"view{view}"
        for view in finding.get("views") or ()
    ]
    done = "put right" if put_right(finding) else "not undone"
    return f"{', '.join(views)}: {words(numbers)}; {done}"
