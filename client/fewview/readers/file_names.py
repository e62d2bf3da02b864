"""Names of files: their natural order, frame numbers, and the parts that distinguish cameras."""

import re
from collections.abc import Sequence
from pathlib import PurePath

_DIGITS = re.compile(r"\d+")
_LAST_NUMBER = re.compile(r"(?<!\d)(\d++)(?=\D*$)")
_SEPARATORS = re.compile(r"([_.\- /\\]+)")


def natural(name: object) -> list[tuple[int, str]]:
    """Return a key that sorts ``cam10`` after ``cam9``."""
    text = str(name).lower()
    parts = _DIGITS.findall(text)
    between = _DIGITS.split(text)
    return [
        (int(parts[i - 1][-18:]) if i else 0, word) for i, word in enumerate(between)
    ]  # 18 digits fit into 64 bits


def frame_number(name: str) -> tuple[str, int] | None:
    """Split ``cam1_000012_keypoints.json`` into (``cam1``, 12); None without a number."""
    stem = name.replace("\\", "/")
    stem = stem[: -len(suffix)] if (suffix := PurePath(stem).suffix) else stem
    if suffix[1:].isdigit():
        stem += suffix
    found = _LAST_NUMBER.search(stem)
    if not found:
        return None
    return stem[: found.start()].rstrip("_.- /"), int(found.group()[-18:])


def split_frames(names: Sequence[str]) -> dict[str, list[tuple[int, int]]]:
    """Sort images of one or several cameras.

    Returns
    -------
    dict
        Of each camera (its name or folder, "" for none) the (frame number, index into `names`) in
        order. Names that have no number, or one number twice, are numbered in natural order.
    """
    cameras: dict[str, list[tuple[int, int]]] = {}
    for index, name in enumerate(names):
        found = frame_number(name)
        if found is None:
            cameras = {}
            break
        cameras.setdefault(found[0], []).append((found[1], index))
    repeated = any(len({n for n, _ in frames}) < len(frames) for frames in cameras.values())
    if not cameras or repeated or len(cameras) > max(1, len(names) // 2):
        order = sorted(range(len(names)), key=lambda index: natural(names[index]))
        return {"": list(enumerate(order))}
    return {name: sorted(cameras[name]) for name in sorted(cameras, key=natural)}


def distinct_parts(names: Sequence[str]) -> tuple[str, ...]:
    """Cut what the names of all views begin and end with, word by word; equal ones are numbered."""
    words = [_SEPARATORS.split(name) for name in names]
    if len(names) > 1:
        while all(len(w) > 2 for w in words) and len({w[-1] for w in words}) == 1:
            words = [w[:-2] for w in words]
        while all(len(w) > 2 for w in words) and len({w[0] for w in words}) == 1:
            words = [w[2:] for w in words]
    short = ["".join(w) for w in words]
    if any(name.isdigit() for name in short):
        short = list(names)
    if len(set(short)) < len(short) or not all(short):
        short = [f"view {number}" for number in range(1, len(names) + 1)]
    return tuple(short)
