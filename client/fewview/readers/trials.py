"""Which files are of one trial: what in their paths names the camera, and what the trial.

Two networks' results of one video are parted alike: a trial is whatever there is one of for
each camera.
"""

import re
from collections.abc import Sequence
from pathlib import Path

from fewview.errors import FormatError
from fewview.readers.file_names import distinct_parts, natural

CAMERAS = (  # the surest words first
    re.compile(
        r"(cam|camera|kamera|view|vue|port|gopro|kinect|phone|iphone|device|dev|sensor)"
        r"([a-z]?\d+|[a-h])[a-z]?",
        re.IGNORECASE,
    ),
    re.compile(r"left|right|front|back|rear|top|bottom|side\d?", re.IGNORECASE),
    re.compile(r"[cv]\d+", re.IGNORECASE),
)
ALONE = ("cam", "camera", "kamera", "view", "port", "gopro")  # before the number of a camera
NETWORK = re.compile(r"(?<=[^_\W])(?=DLC_)")  # where DeepLabCut's name of the network begins
_WORDS = re.compile(r"[^_.\- /\\]+")


def names_of_paths(paths: Sequence[Path], names: Sequence[str]) -> list[str]:
    """Return what files are called: their names, or, where these are the same, with their folders.

    Parameters
    ----------
    paths
        Of the files, or of the folders of frames.
    names
        Their own.
    """
    if len(set(names)) == len(names):
        return list(names)
    parts = [[*path.absolute().parent.parts, name] for path, name in zip(paths, names, strict=True)]
    while all(len(p) > 1 for p in parts) and len({p[0] for p in parts}) == 1:
        parts = [p[1:] for p in parts]
    while all(len(p) > 1 for p in parts) and len({p[-1] for p in parts}) == 1:
        parts = [p[:-1] for p in parts]
    return ["/".join(p) for p in parts]


def of_one_trial(names: Sequence[str], trial: str | None) -> tuple[list[int], list[str], str]:
    """Return which files are of the trial that was asked for, or of the only one.

    Returns
    -------
    tuple
        Indices of the files, their cameras' names, and what to note ("" for nothing).

    Raises
    ------
    FormatError
        If there are several trials, and none or no such one was asked for.
    """
    parted = _by_camera(names) or _by_grid(names)
    if parted is None:
        if trial is not None:
            raise FormatError(
                f"{trial!r}: the files are of one trial, a camera each: {_shown(names)}",
                option="trial",
            )
        return list(range(len(names))), list(names), ""
    cameras, trials = parted
    short = dict(
        zip(dict.fromkeys(trials), distinct_parts(list(dict.fromkeys(trials))), strict=True)
    )
    called = [short[each] for each in trials]
    known = sorted(set(called), key=natural)
    if trial is None:
        raise FormatError(
            f"the files are of {len(known)} trials or detectors ({_shown(known)}) of the same "
            f"cameras ({_shown(sorted(set(cameras), key=natural))}): name one, or give its files "
            "alone",
            option="trial",
            remedy=known[0],
        )
    wanted = {called[i] for i, full in enumerate(trials) if trial in (called[i], full)}
    wanted = wanted or {each for each in known if trial in _WORDS.findall(each)}
    if len(wanted) != 1:
        raise FormatError(f"there is no trial {trial!r}; there are {_shown(known)}", option="trial")
    mine = [i for i, each in enumerate(called) if each in wanted]
    note = f"of {len(known)} trials or detectors ({_shown(known)}), {wanted.pop()} was taken"
    return mine, [cameras[i] for i in mine], note


def _shown(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")


def _words(name: str) -> list[str]:
    """Return the words of a name, a word such as ``cam`` together with the number after it."""
    words: list[str] = []
    for word in _WORDS.findall(NETWORK.sub("_", name)):
        if words and words[-1].lower() in ALONE and word.isdecimal():
            words[-1] += word
        else:
            words.append(word)
    return words


def _by_camera(names: Sequence[str]) -> tuple[list[str], list[str]] | None:
    """Return the camera and the trial of each, if all name a camera and some name the same."""
    ways = [[_split_by(camera, name) for name in names] for camera in CAMERAS]
    ways.append([_split_by_network(name) for name in names])
    for way in ways:
        known = [each for each in way if each is not None]
        if len(known) == len(names):
            cameras, trials = zip(*known, strict=True)
            several = len(set(cameras)) < len(names) and len(set(known)) == len(names)
            return (list(cameras), list(trials)) if several else None
    return None


def _split_by(camera: re.Pattern[str], name: str) -> tuple[str, str] | None:
    """Return the one word of a name that is a camera's, and the others; None without."""
    words = _words(name)
    found = [word for word in words if camera.fullmatch(word)]
    if len(found) != 1:
        return None
    return found[0], "_".join(word for word in words if word != found[0])


def _split_by_network(name: str) -> tuple[str, str] | None:
    """Return the name of a video, and that of DeepLabCut's network; None without."""
    video, *network = NETWORK.split(name, maxsplit=1)
    return (video, network[0]) if network else None


def _by_grid(names: Sequence[str]) -> tuple[list[str], list[str]] | None:
    """Return two parts of each name, if the names are all pairs of these.

    Raises
    ------
    FormatError
        If they are: which of the parts names the camera cannot be known.
    """
    words = [_words(name) for name in names]
    if len({len(each) for each in words}) != 1:
        return None
    varied = [column for column in zip(*words, strict=True) if len(set(column)) > 1]
    kinds: dict[tuple[int, ...], tuple[str, ...]] = {}
    for column in varied:  # columns that vary together are one
        kinds.setdefault(tuple(map(column.index, column)), column)
    if len(kinds) != 2:
        return None
    one, other = kinds.values()
    sizes = [len(set(one)), len(set(other))]
    if sizes[0] * sizes[1] != len(names) or len(set(zip(one, other, strict=True))) != len(names):
        return None
    raise FormatError(
        f"the files are {sizes[0]} x {sizes[1]}: {_shown(list(dict.fromkeys(one)))} and "
        f"{_shown(list(dict.fromkeys(other)))}, and it is unknown which of these are cameras and "
        "which trials: give the files of one trial, or call cameras cam1, cam2, ..."
    )
