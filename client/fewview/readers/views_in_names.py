"""Keypoints whose names have a camera in them: one image, or one file, that holds several views.

A mirror in the image is a second camera (`real_nose`, `mirror_nose`); tools join the tables of
cameras (`cam1_nose`, `left_view.nose`, `nose_top`). The words of cameras stand first or last.
"""

import re
from collections.abc import Sequence
from dataclasses import replace

from fewview.errors import FormatError
from fewview.readers.views import View, with_keypoints
from fewview.reading_options import NONE

FEWEST, IN_COMMON = 4, 0.5  # keypoints that views have in common, and their share of all
_BETWEEN = "_.-/ :"
# Words that are of cameras and of no part of a body, where equal parts follow each of them.
_ALONE = {"real", "direct", "top", "bot", "bottom", "side", "dorsal", "ventral", "lateral"}
_CAMERAS = ("camera", "cam", "view")
_MIRRORS = ("mirror", "reflect")
_IS_MIRROR = re.compile(r"(?<![a-z])(?:mirror|reflect)(?!less)(?!.*flip)")
LONGEST = 16  # characters of such a word
Parted = dict[str, list[tuple[str, int]]]  # of each word the keypoints, and their places


def with_views_in_names(views: Sequence[View], words: Sequence[str] | None) -> list[View]:
    """Return the views, with those parted whose keypoints' names have cameras in them.

    Parameters
    ----------
    words
        Those of the cameras; None to find them; ``["none"]`` if there are none.

    Raises
    ------
    FormatError
        If words are given, and names of keypoints do not begin or end with them.
    """
    if words is not None and [word.lower() for word in words] == [NONE]:
        return list(views)
    out: list[View] = []
    for view in views:
        names = view.keypoint_names or ()
        found = cameras_in(names) if words is None else _given(names, words)
        if words is not None and len(found) < 2:
            raise FormatError(
                f"its keypoints are {', '.join(names[:6]) or 'without names'}, and do not begin or "
                f"end with {' or '.join(words)}",
                place=view.name,
                option="views_in_names",
                remedy=NONE,
            )
        out += _parted(view, found, several=len(views) > 1) if found else [view]
    return out


def cameras_in(names: Sequence[str]) -> Parted:
    """Return the keypoints of each camera that names have in them; none if they have no cameras.

    All names begin, or all end, with words of cameras, which have most keypoints in common.
    """
    for last in (False, True):
        for counts in ((1, 2), (2, 1)):
            found: Parted = {}
            for place, name in enumerate(names):
                split = (_split(name.strip(), count, last=last) for count in counts)
                word, part = next((each for each in split if _is_camera(each[0])), ("", ""))
                if not word:
                    break
                found.setdefault(word, []).append((part, place))
            else:
                sets = [{name for name, _ in each} for each in found.values()]
                common = set.intersection(*sets) if len(sets) > 1 else set()
                if len(common) >= FEWEST and len(common) > IN_COMMON * len(set.union(*sets)):
                    return found
    return {}


def _split(name: str, count: int, *, last: bool) -> tuple[str, str]:
    """Return the first words of a name, or the last, and what is left; "" twice of too few."""
    places = [place for place, character in enumerate(name) if character in _BETWEEN]
    if len(places) < count:
        return "", ""
    place = places[-count] if last else places[count - 1]
    before, after = name[:place].rstrip(_BETWEEN), name[place + 1 :].lstrip(_BETWEEN)
    if not before or not after:
        return "", ""
    return (after, before) if last else (before, after)


def _is_camera(word: str) -> bool:
    plain = "".join(" " if character in _BETWEEN else character for character in word.lower())
    parts = plain.split()
    if not parts or max(map(len, parts)) > LONGEST:
        return False
    if parts[-1].startswith(_MIRRORS):
        return True
    if len(parts) == 1:
        return plain in _ALONE or plain.startswith(_CAMERAS) or plain.endswith(_CAMERAS)
    return parts[0] in _CAMERAS or parts[1] in _CAMERAS


def _given(names: Sequence[str], words: Sequence[str]) -> Parted:
    """Return the keypoints of each of the words that are given; others have none."""
    found: Parted = {}
    for word in words:
        for place, name in enumerate(map(str.strip, names)):
            part = ""
            if name.lower().startswith(word.lower()):
                part = name[len(word) :].lstrip(_BETWEEN)
            elif name.lower().endswith(word.lower()):
                part = name[: -len(word)].rstrip(_BETWEEN)
            if part:
                found.setdefault(word, []).append((part, place))
    return found


def _parted(view: View, cameras: Parted, *, several: bool) -> list[View]:
    out = []
    names = view.keypoint_names or ()
    taken = {place for each in cameras.values() for _, place in each}
    left = [name for place, name in enumerate(names) if place not in taken]
    for word, keypoints in cameras.items():
        places = {place: new for new, (_, place) in enumerate(keypoints)}
        notes = [f"its keypoints are those with {word!r} in their names (--views-in-names)"]
        if left:
            notes.append(f"{', '.join(left)} left out, as their names have no camera")
        edges = [(places[a], places[b]) for a, b in view.edges or () if {a, b} <= places.keys()]
        out.append(
            replace(
                with_keypoints(view, list(places)),
                name=f"{view.name}_{word}" if several else word,
                keypoint_names=tuple(name for name, _ in keypoints),
                edges=tuple(edges) or None,
                points3d=None,
                notes=(*view.notes, *notes),
            )
        )
    return out


def with_mirrors(views: Sequence[View]) -> list[View]:
    """Return the views; those with names of mirrors are marked as mirrored, if not all have.

    One whose name has "flip" in it was put right before, and is as a camera saw it.
    """
    mirrors = [_IS_MIRROR.search(view.name.lower()) is not None for view in views]
    if all(mirrors):
        return list(views)
    note = "its name is a mirror's, so it is taken for a mirror's image (--mirror none if not)"
    return [
        replace(view, mirrored=True, notes=(*view.notes, note)) if mirror else view
        for view, mirror in zip(views, mirrors, strict=True)
    ]
