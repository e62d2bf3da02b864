"""Lightning Pose: tables as of DeepLabCut; views in mirrors are parts of one image.

Keypoints such as ``paw_top`` and ``paw_bot`` are one keypoint in two views.
"""

from dataclasses import replace

from fewview.readers.formats import deeplabcut
from fewview.readers.separated import table_of
from fewview.readers.sources import Source
from fewview.readers.views import View, with_keypoints

SCORERS = ("heatmap", "ensemble", "eks", "lightning")
VIEWS = ("top", "bot", "bottom", "side", "mirror", "cam", "view")
FEWEST = 4  # keypoints that views have in common


def fits(source: Source) -> bool:
    """Whether a table has a scorer of Lightning Pose, or keypoints named by views."""
    table = table_of(source) if deeplabcut.fits_csv(source) else None
    if table is None:
        return False
    header = {row[0].lower(): row[1:] for row in table.header}
    scorer = (header.get("scorer") or ("",))[-1].lower()
    return scorer.startswith(SCORERS) or bool(_views(list(header.get("bodyparts", ()))))


def read(source: Source) -> list[View]:
    """Return the view of a CSV file, or several where its keypoints are named by views.

    Raises
    ------
    FormatError
        If it is no table.
    """
    views = deeplabcut.read_csv(source)
    if len(views) > 1:  # keypoints name their cameras
        return views
    view = views[0]
    names = list(view.keypoint_names or ())
    out = []
    for suffix, mine in _views(names).items():
        index = [names.index(f"{name}_{suffix}") for name in mine]
        out.append(
            replace(
                with_keypoints(view, index),
                name=suffix,
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
