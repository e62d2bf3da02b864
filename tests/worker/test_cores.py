"""The cores of a container are those it was given, not those of its host."""

import os
from pathlib import Path

import pytest

from worker.cores import usable_cores

HERE = len(os.sched_getaffinity(0))
V2 = "sys/fs/cgroup"
V1 = "sys/fs/cgroup/cpu"


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, HERE),
        ({f"{V2}/cpu.max": "max 100000"}, HERE),
        ({f"{V2}/cpu.max": "100000 100000"}, 1),
        ({f"{V2}/cpu.max": "50000 100000"}, 1),
        ({f"{V2}/cpu.max": "100000000 100000"}, HERE),
        ({"proc/self/cgroup": "0::/a/b\n", f"{V2}/a/b/cpu.max": "100000 100000"}, 1),
        ({"proc/self/cgroup": "0::/a/b\n", f"{V2}/a/cpu.max": "100000 100000"}, 1),
        ({"proc/self/cgroup": "0::/a/b\n", f"{V2}/other/cpu.max": "100000 100000"}, HERE),
        ({"proc/self/cgroup": "0::/../../other\n", f"{V2}/cpu.max": "100000 100000"}, 1),
        ({f"{V1}/cpu.cfs_quota_us": "100000", f"{V1}/cpu.cfs_period_us": "100000"}, 1),
        ({f"{V1}/cpu.cfs_quota_us": "-1", f"{V1}/cpu.cfs_period_us": "100000"}, HERE),
        (
            {
                "proc/self/cgroup": "5:cpu,cpuacct:/x\n0::/\n",
                f"{V1}/x/cpu.cfs_quota_us": "100000",
                f"{V1}/x/cpu.cfs_period_us": "100000",
            },
            1,
        ),
        ({f"{V2}/cpu.max": "what is this"}, HERE),
    ],
)
def test_quotas_of_control_groups(files: dict[str, str], cores: int, tmp_path: Path) -> None:
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert usable_cores(tmp_path) == cores
