"""How long `fewview convert` takes for long tables, and how much memory.

    python benchmarks/convert.py [--frames 360000] [--views 4] [--keypoints 133]

Writes a table of text for each camera into a temporary folder (four of an hour at 100 frames per
second with 133 keypoints take 4.4 GB, and reading them some 7 GB more) and converts them as people
do, in a process of its own. Memory is the most that this process ever had.
"""

import argparse
import os
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.figures import Bar, Results, Row, command
from worker.process import python

REPEATED = 1000  # frames that are drawn; the others are the same again
UNSEEN = 0.02  # of the keypoints, written as (0, 0)
SECONDS, MEGABYTES = 60.0, 1500.0  # for four cameras of an hour
NUMBERS = 360_000 * 4 * 133 * 3
LEAST_SECONDS = 5.0  # Python and its libraries start, however short the tables


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    with tempfile.TemporaryDirectory(prefix="fewview-") as folder:
        tables = [
            table(Path(folder, f"cam{view + 1}.csv"), arguments.frames, arguments.keypoints, view)
            for view in range(arguments.views)
        ]
        row = converted(tables, Path(folder, "capture.npz"))
    share = arguments.frames * arguments.views * arguments.keypoints * 3 / NUMBERS
    bars = [
        Bar("fewview convert", max(SECONDS * share, LEAST_SECONDS), row["seconds"], "s"),
        Bar("memory of fewview convert", MEGABYTES, row["memory MB"], "MB"),
    ]
    Results("convert", vars(arguments), {"Conversion of tables": [row]}, bars).publish(
        arguments.json
    )


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Measure how long tables of text are converted.")
    parser.add_argument("--frames", type=int, default=360_000)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--keypoints", type=int, default=133)
    return parser.parse_args()


def table(path: Path, frames: int, keypoints: int, seed: int) -> Path:
    """Write a row of x, y and confidence of all keypoints for each frame."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(200, 1500, (keypoints, 2)) + rng.normal(0, 30, (REPEATED, keypoints, 2))
    places[rng.random((REPEATED, keypoints)) < UNSEEN] = 0
    values = np.dstack([places, rng.uniform(0.3, 1, (REPEATED, keypoints))])
    rows = [",".join(f"{value:.3f}" for value in frame) for frame in values.reshape(REPEATED, -1)]
    names = (f"point{k}_{axis}" for k in range(keypoints) for axis in ("x", "y", "confidence"))
    with path.open("w") as file:
        file.write(f"frame,{','.join(names)}\n")
        file.writelines(f"{frame},{rows[frame % REPEATED]}\n" for frame in range(frames))
    return path


def converted(tables: list[Path], out: Path) -> Row:
    """Return what converting tables takes."""
    words = python("-m", "fewview.cli", "convert", *map(str, tables), "-o", str(out), "--json")
    started = time.perf_counter()
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL)  # noqa: S603 (our own program)
    _, status, used = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - started
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit("convert.py: fewview convert failed")
    return {
        "tables GB": sum(path.stat().st_size for path in tables) / 1e9,
        "seconds": seconds,
        "of a processor": used.ru_utime + used.ru_stime,
        "memory MB": used.ru_maxrss * 1024 / 1e6,  # Linux counts in KiB
        "npz GB": out.stat().st_size / 1e9,
    }


if __name__ == "__main__":
    main()
