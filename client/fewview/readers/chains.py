"""Skeletons written as words and chains of words, such as ``left_hip-left_knee-left_ankle``."""

from dataclasses import dataclass
from itertools import pairwise

from fewview.readers.views import Edges


@dataclass(frozen=True)
class Skeleton:
    """P names of keypoints and the pairs of them that are joined."""

    title: str
    names: tuple[str, ...]
    edges: Edges


def skeleton(title: str, names: str, joined: str) -> Skeleton:
    """Build one from words and from chains of words, such as ``left_hip-left_knee-left_ankle``."""
    words = tuple(names.split())
    place = {name: index for index, name in enumerate(words)}
    edges: list[tuple[int, int]] = []
    for chain in joined.split():
        links = [place[name] for name in chain.split("-")]
        edges += pairwise(links)
    return Skeleton(title, words, tuple(edges))


def both(chains: str) -> str:
    """Return chains with L and R in place of each ``*``."""
    return " ".join(chain.replace("*", side) for chain in chains.split() for side in ("L", "R"))


def sides(chains: str) -> str:
    """Return chains with left and right in place of each ``*``."""
    words = chains.split()
    return " ".join(word.replace("*", side) for word in words for side in ("left", "right"))
