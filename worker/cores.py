"""How many processor cores there are to use."""

import math
import os
from contextlib import suppress
from pathlib import Path


def usable_cores(root: Path = Path("/")) -> int:
    """Return the cores that this process may use: those of its affinity, less if it has a quota.

    A container is given a share of the processor's time as a quota of its control group, version 2
    or 1 (cgroups(7)); threads beyond it only wait for each other. Part of a core counts as one.

    Parameters
    ----------
    root
        Where ``proc`` and ``sys`` are mounted.
    """
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    return max(1, min([cores, *(math.ceil(quota) for quota in _quotas(root))]))


def _quotas(root: Path) -> list[float]:
    """Return the quotas, in cores, of the control groups that this process is in."""
    mounted = root / "sys/fs/cgroup"
    quotas = []
    for folder, limits in (("", ("cpu.max",)), ("cpu", ("cpu.cfs_quota_us", "cpu.cfs_period_us"))):
        group = mounted / folder / _group(root, folder).lstrip("/")
        # A container sees its own group as the root, or the path of it on the host, which is not
        # there; every group above has its own quota.
        for at in (group, *group.parents):
            if at.is_relative_to(mounted / folder):
                with suppress(OSError, ValueError, ZeroDivisionError):
                    words = " ".join((at / name).read_text() for name in limits).split()
                    quota, period = (float(word) for word in words)  # "max" is no number
                    if quota > 0:  # -1: none, in version 1
                        quotas.append(quota / period)
    return quotas


def _group(root: Path, controller: str) -> str:
    """Return the path of this process's group; version 2 has no controller's name."""
    with suppress(OSError):
        for line in (root / "proc/self/cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controller in controllers.split(",") and ".." not in path:
                return path
    return ""
