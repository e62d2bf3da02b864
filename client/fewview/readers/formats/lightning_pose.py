"""Lightning Pose: tables as of DeepLabCut; views in mirrors are parts of one image.

Keypoints such as ``paw_top`` and ``paw_bot`` are one keypoint in two views.
"""

from dataclasses import replace

from fewview.readers.formats import deeplabcut
from fewview.readers.sources import Source
from fewview.readers.views import View

SCORERS = ("heatmap", "ensemble", "eks", "lightning")
VIEWS = ("top", "bot", "bottom", "side", "mirror", "cam", "view")
FEWEST = 4  # keypoints that views have in common


def fits(source: Source) -> bool:
    """Whether a table has a scorer of Lightning Pose, or keypoints named by views."""
    if not deeplabcut.fits_csv(source):
        return False
    header = {line.partition(",")[0]: line.split(",")[1:] for line in source.lines[:4]}
    scorer = (header.get("scorer") or [""])[-1].lower()
    return scorer.startswith(SCORERS) or bool(_views(header["bodyparts"]))


def read(source: Source) -> list[View]:
    """Return the view of a CSV file, or several where its keypoints are named by views.

    Raises
    ------
    FormatError
        If it is no table.
    """
    (view,) = deeplabcut.read_csv(source)
    names = list(view.keypoint_names or ())
    out = []
    for suffix, mine in _views(names).items():
        index = [names.index(f"{name}_{suffix}") for name in mine]
        out.append(
            replace(
                view,
                name=suffix,
                keypoints=view.keypoints[:, :, index],
                confidence=None if view.confidence is None else view.confidence[:, :, index],
                keypoint_names=tuple(mine),
                notes=(*view.notes, f"keypoints named ..._{suffix} were taken for this view"),
            )
        )
    return out or [view]


def _views(names: list[str]) -> dict[str, list[str]]:
    """Return the keypoints of each view that keypoints are named by; none if they are not."""
    views: dict[str, list[str]] = {}
    for name in dict.fromkeys(names):
        keypoint, _, suffix = name.strip().rpartition("_")
        if not keypoint or not suffix.lower().rstrip("0123456789").startswith(VIEWS):
            return {}
        views.setdefault(suffix, []).append(keypoint)
    common = set.intersection(*map(set, views.values())) if views else set()
    return views if len(views) > 1 and len(common) >= FEWEST else {}
