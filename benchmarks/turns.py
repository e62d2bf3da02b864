"""Two projects at the workers: how long one's many fits delay the other's, and what was expected.

    python -m benchmarks.turns [--fits 40] [--workers 2] [--json FILE]

Starts a service, makes some fits that it can measure, and queues many fits of two lengths for one
project, two of them `high`. While they run another project queues three. Beside each that had to
wait stands what `GET /fits/{id}/schedule` expected of it when the last of all was queued.
"""

import argparse
import time
from contextlib import ExitStack
from datetime import datetime
from typing import Any, NamedTuple

import httpx2
import numpy as np

from benchmarks.captures import studio
from benchmarks.figures import Bar, Results, Row, command
from benchmarks.service_rig import Service, service

QUICK: dict[str, Any] = {"dictionary_sizes": [16, 8], "cameras": "moving", "refine": "off"}
STEPS = (100, 1000)  # of short and long fits
FRAMES = 200
MEASURED = 6  # fits before anything is expected
OTHERS = 3
MOST_OFF = 0.25  # of the wait
POLL_SECONDS = 1.0


class User(NamedTuple):
    """A key of a project of its own, and a dataset."""

    client: httpx2.Client
    dataset: str

    def ask(self, steps: int, priority: str = "normal") -> str:
        """Queue a fit and return its identifier."""
        body = {
            "dataset_id": self.dataset,
            "config": QUICK | {"steps": steps},
            "priority": priority,
        }
        return str(self.client.post("/fits", json=body).raise_for_status().json()["id"])

    def schedule(self, fit: str) -> Row:
        """Return what is expected of a fit."""
        found: Row = self.client.get(f"/fits/{fit}/schedule").raise_for_status().json()
        return found

    def wait(self, fits: list[str]) -> list[Row]:
        """Wait until all fits have ended; return their records."""
        while True:
            page = self.client.get("/fits", params={"limit": 200}).raise_for_status().json()
            records = {record["id"]: record for record in page["items"]}
            if all(records[fit]["finished_at"] for fit in fits):
                return [records[fit] for fit in fits]
            time.sleep(POLL_SECONDS)


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    with ExitStack() as stack:
        running = stack.enter_context(service("--workers", str(arguments.workers)))
        busy, other = (_user(stack, running, name) for name in ("busy", "other"))
        busy.wait([busy.ask(STEPS[place % 2]) for place in range(MEASURED)])
        many = [busy.ask(STEPS[place % 2]) for place in range(arguments.fits)]
        urgent = [busy.ask(STEPS[0], "high") for _ in range(2)]
        busy.wait(many[:1])
        few = [other.ask(STEPS[0]) for _ in range(OTHERS)]
        mine = [(busy, fit) for fit in (*many, *urgent)] + [(other, fit) for fit in few]
        expected = [user.schedule(fit) for user, fit in mine]
        ended = busy.wait([*many, *urgent]) + other.wait(few)
    both = zip(ended, expected, strict=True)
    waiting = [(fit, schedule) for fit, schedule in both if schedule["status"] == "queued"]
    rows = [_row(*each) for each in sorted(waiting, key=lambda each: str(each[0]["started_at"]))]
    first = min(ended[-OTHERS:], key=lambda fit: str(fit["started_at"]))
    begun = [moment(fit["started_at"]) for fit in ended[:-OTHERS]]
    before = sum(moment(first["created_at"]) < at < moment(first["started_at"]) for at in begun)
    waited = np.array([row["waited s"] for row in rows])
    off = np.abs([row["off s"] for row in rows]) / np.maximum(waited, 1.0)
    delay = moment(first["started_at"]) - moment(first["created_at"])
    longest = max(moment(fit["finished_at"]) - moment(fit["started_at"]) for fit in ended)
    bars = [
        Bar(
            "fits that begin before the other's first, a worker", 1, before / arguments.workers, ""
        ),
        Bar("delay of the other's first, of the longest fit", 1.25, delay / longest, "x"),
        Bar("starts expected wrongly, of the wait, median", MOST_OFF, float(np.median(off)), ""),
        Bar("pairs in the order that was expected", 0.9, _in_order(rows), "", least=True),
    ]
    Results("turns", vars(arguments), {"Fits that had to wait": rows}, bars).publish(arguments.json)


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Measure how projects take turns, and what fits expect.")
    parser.add_argument("--fits", type=int, default=30, help="of the project that has many")
    parser.add_argument("--workers", type=int, default=2)
    return parser.parse_args()


def moment(text: str) -> float:
    """Return a moment of the API in seconds."""
    return datetime.fromisoformat(text).timestamp()


def _user(stack: ExitStack, running: Service, project: str) -> User:
    asked = {"name": project, "project": project, "scopes": ["read", "write"]}
    token = running.client.post("/keys", json=asked).raise_for_status().json()["token"]
    headers = {"Authorization": f"Bearer {token}"}
    client = httpx2.Client(base_url=running.address, headers=headers, timeout=600, trust_env=False)
    stack.enter_context(client)
    return User(client, Service(running.address, client).upload(studio(frames=FRAMES)))


def _row(fit: Row, schedule: Row) -> Row:
    start, end = moment(fit["started_at"]), moment(fit["finished_at"])
    return {
        "fit": fit["id"][-6:],
        "priority": fit["priority"],
        "steps": fit["config"]["steps"],
        "ahead": schedule["ahead"],
        "waited s": start - moment(fit["created_at"]),
        "off s": moment(schedule["expected_start"]) - start,
        "took s": end - start,
        "end off s": moment(schedule["expected_end"]) - end,
    }


def _in_order(rows: list[Row]) -> float:
    """Return the share of pairs of fits that started in the expected order; `rows` are as begun."""
    pairs = [
        earlier["ahead"] < later["ahead"]
        for place, later in enumerate(rows)
        for earlier in rows[:place]
    ]
    return float(np.mean(pairs)) if pairs else 1.0


if __name__ == "__main__":
    main()
