"""How long a body of any content keeps other requests of its process waiting, and what it takes.

    python benchmarks/stalls.py [--bodies] [--only TEXT ...] [--json FILE]

Starts a service with one API process. One key does its worst, in one way after another, while
another project lifts: how long that took at most, and what was refused to it. With `--bodies`, or
with names, one case after another is sent to it before, while another process asks `/health/live`
every 5 ms. Beside each case stand the longest of these waits, and the growth of the API process's
memory, of the body's bytes too.
"""

import argparse
import multiprocessing
import time
from multiprocessing.connection import Connection
from pathlib import Path

import httpx2

from benchmarks import stalls_shares
from benchmarks.captures import fitted, studio
from benchmarks.figures import Bar, Results, Row, command
from benchmarks.service_rig import Service, api_processes, service
from benchmarks.stalls_cases import Case, cases
from benchmarks.stalls_work import QUICK
from models.settings.config import FitConfig

PAUSE_SECONDS = 0.005
QUIET_SECONDS = 2.0
FRAMES = 300  # of the capture that the model is fitted to, as quickly as may be
LONGEST_MS, MOST_TIMES = 100.0, 10.0
# Webhooks of this machine, and turns of fits that a short run sees.
OPTIONS = ("--api-processes=1", "--webhook-private-targets=true", "--fit-turn-seconds=2")
LEAST_BYTES = 8 * 2**20  # what a body counts at least: allocators keep that much anyway


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    with service(*OPTIONS) as running, Watch(running.address) as watch:
        (api,) = api_processes()
        capture = studio(frames=FRAMES)
        prior = fitted(capture, FitConfig.model_validate(QUICK))
        model = running.import_model(prior)
        rows = [quiet(watch)]
        for case in cases(running, model) if arguments.bodies or arguments.only else ():
            if any(text in case.name for text in arguments.only or [""]):
                rows.append(measure(running, api, watch, case))
                print(rows[-1], flush=True)
        rows.append(quiet(watch))
        shared = []
        for row in stalls_shares.rows(running, prior, capture.keypoints, arguments.only or [""]):
            shared.append(row)
            print(row, flush=True)
    noise = max(row["longest wait ms"] for row in (rows[0], rows[-1]))
    sent = rows[1:-1]
    bars = [
        Bar(
            "longest wait beside a body, above that beside none",
            LONGEST_MS,
            max((row["longest wait ms"] for row in sent), default=0.0) - noise,
            "ms",
        ),
        Bar(
            "memory, of the body",
            MOST_TIMES,
            max((row["memory / body"] for row in sent), default=0.0),
            "x",
        ),
    ]
    bars = bars if sent else []
    if shared:
        longest = max(row["another's longest lift ms"] for row in shared)
        bars += [
            Bar("another project's lift beside one key at its worst", LONGEST_MS, longest, "ms"),
            Bar("refused to it", 0, sum(row["refused"] for row in shared), ""),
        ]
    tables = {"Beside a body": rows, "Another project beside one key at its worst": shared}
    Results("stalls", vars(arguments), tables, bars).publish(arguments.json)


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Measure how long bodies keep other requests waiting.")
    parser.add_argument("--only", nargs="+", default=[], help="cases whose names have this")
    parser.add_argument(
        "--bodies", action="store_true", help="send bodies up to the limits, too, which takes long"
    )
    return parser.parse_args()


def quiet(watch: "Watch") -> Row:
    """Return how long requests wait where nothing else is asked."""
    watch.begin()
    time.sleep(QUIET_SECONDS)
    return {"case": "nothing", "longest wait ms": 1000 * watch.end()}


def measure(running: Service, api: int, watch: "Watch", case: Case) -> Row:
    """Send a case, and return what became of it."""
    send, size = case.make()
    before = begin_peak(api)
    watch.begin()
    began = time.perf_counter()
    answer = send(running.client)
    seconds = time.perf_counter() - began
    longest = watch.end()
    growth = max(0, memory(api, "VmHWM") - before)
    return {
        "case": case.name,
        "longest wait ms": 1000 * longest,
        "memory / body": growth / max(size, LEAST_BYTES) if size else 0.0,  # else the answer's
        "growth MiB": growth / 2**20,
        "body MiB": size / 2**20,
        "s": seconds,
        "answer": answer,
    }


def begin_peak(process: int) -> int:
    """Forget the most memory that a process has had, and return what it has."""
    Path(f"/proc/{process}/clear_refs").write_text("5")
    return memory(process, "VmRSS")


def memory(process: int, name: str) -> int:
    """Return a figure of a process's memory, in bytes."""
    rows = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(1024 * int(row.split()[1]) for row in rows if row.startswith(f"{name}:"))


class Watch:
    """A process that asks all the time whether the service is alive."""

    def __init__(self, address: str) -> None:
        context = multiprocessing.get_context("spawn")
        self._ours, theirs = context.Pipe()
        self._process = context.Process(target=ask, args=(address, theirs), daemon=True)

    def __enter__(self) -> "Watch":
        self._process.start()
        self._ours.recv()
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()

    def begin(self) -> None:
        """Note how long requests wait from now on."""
        self._talk()

    def end(self) -> float:
        """Return how long one has waited at most, in seconds."""
        return self._talk()

    def _talk(self) -> float:
        self._ours.send(None)
        found: float = self._ours.recv()
        return found


def ask(address: str, channel: Connection) -> None:
    """Ask, and send the longest wait whenever somebody wants to know it."""
    with httpx2.Client(base_url=address, timeout=600, trust_env=False) as client:
        client.get("/health/live")
        channel.send(0.0)
        longest = 0.0
        while True:
            began = time.perf_counter()
            client.get("/health/live")
            longest = max(longest, time.perf_counter() - began)
            if channel.poll():
                channel.recv()
                channel.send(longest)
                longest = 0.0
            time.sleep(PAUSE_SECONDS)


if __name__ == "__main__":
    main()
