"""Shares of what is bounded: what one project may take of it, and one key of a project.

Whatever is taken already, more is free than a newcomer needs: one key may have three times as much
as it leaves free, its project seven times as much. So one key has three quarters of the whole at
most, and one project seven eighths; the more of them want something, the less each may have (the
dynamic thresholds of Choudhury and Hahne, IEEE/ACM Transactions on Networking 6, 1998). Who has
nothing may take whatever is free.

Where no key is in force there is one user alone, who may have the whole.
"""

from typing import NamedTuple, TypeVar

from store.records import Owned

Name = TypeVar("Name", "Who", str)

# In place of a key's identifier, where there is none: jobs that came by the queue.
NO_KEY = ""

OF_KEY, OF_PROJECT = 3, 7  # times what is left free


class Who(NamedTuple):
    """Whose share it is."""

    project: str
    key_id: str


def who_owns(record: Owned) -> Who:
    """Return whose share a record takes from."""
    return Who(record.project, record.key_id or NO_KEY)


def is_within(count: int, *, of_key: int, of_project: int, free: int) -> bool:
    """Return whether somebody may take so much more.

    Parameters
    ----------
    of_key, of_project
        What the key has already, and all keys of its project together.
    free
        What nobody has.
    """
    left = free - count
    return (
        left >= 0
        and (not of_key or of_key + count <= OF_KEY * left)
        and (not of_project or of_project + count <= OF_PROJECT * left)
    )


class Shares:
    """Who has how much of something bounded. Not safe to use from several threads."""

    def __init__(self, whole: int) -> None:
        """Begin with the whole free."""
        self.whole = self.free = whole
        self._of_keys: dict[Who, int] = {}
        self._of_projects: dict[str, int] = {}

    def may_take(self, who: Who, count: int = 1) -> bool:
        """Return whether so much more is within the shares of a key and its project."""
        return is_within(
            count,
            of_key=self._of_keys.get(who, 0),
            of_project=self._of_projects.get(who.project, 0),
            free=self.free,
        )

    def take(self, who: Who, count: int = 1) -> None:
        """Note that a key has so much more."""
        self.free -= count
        _add(self._of_keys, who, count)
        _add(self._of_projects, who.project, count)

    def give_back(self, who: Who, count: int = 1) -> None:
        """Note that a key has so much less."""
        self.free += count
        _add(self._of_keys, who, -count)
        _add(self._of_projects, who.project, -count)

    def has_its_share(self, who: Who) -> bool:
        """Return whether the project has as much as each would have if all had equally much."""
        projects = len(self._of_projects.keys() | {who.project})
        return self._of_projects.get(who.project, 0) * projects >= self.whole - self.free > 0


def _add(counts: dict[Name, int], name: Name, count: int) -> None:
    """Change a count; what nobody has is left out."""
    total = counts.get(name, 0) + count
    if total:
        counts[name] = total
    else:
        counts.pop(name, None)
