"""What must hold after a round: nothing lost, nothing changed, nothing undead, every job ended."""

import io
import time
from collections import Counter
from collections.abc import Callable, Iterable
from random import Random
from typing import Any

import numpy as np
from safetensors.numpy import save

from benchmarks.chaos_api import Api
from benchmarks.chaos_ledger import KINDS, Kind, Ledger, Thing, digest_of
from store import housekeeping
from store.database import Store
from store.settings import StoreSettings

END_SECONDS = 180.0  # after the last fault of a round, for all its jobs to end
FOUND_SECONDS = 30.0  # for a job on the queue to be recorded
SAMPLE = 6  # older things that are read again after each round
FILES = {
    "datasets": "/capture",
    "fits": "/reconstruction?format=safetensors",
    "models": "/weights",
    "lifts": "/result?format=safetensors",
}


class Checks:
    """Holds a deployment against a ledger; what does not agree is reported."""

    def __init__(self, api: Api, ledger: Ledger, report: Callable[[str], None]) -> None:
        self.counts: Counter[str] = Counter()
        self._api, self._ledger, self._report = api, ledger, report

    def ends(self, number: int) -> None:
        """Wait for the end of every job of a round, and hold it against what was expected."""
        deadline = time.monotonic() + END_SECONDS
        for job in [t for t in self._ledger.things if t.round == number]:
            if job.kind not in ("fits", "lifts") or job.identifier is None:
                continue
            record = self._end_of(job, deadline)
            if record is None:
                continue
            status = record["status"]
            self.counts[f"{job.kind} {status}"] += 1
            allowed = {job.outcome} | ({"cancelled"} if job.cancel else set())
            if job.kind == "lifts" and job.cancel == "accepted":
                allowed = {"cancelled"}
            if status not in allowed:
                why = record.get("error")
                self._report(f"{job.path} ({job.name}) {status}, not {sorted(allowed)}: {why}")
            job.outcome = status
            if record.get("model_id") and job.kind == "fits" and status == "succeeded":
                model = Thing("models", job.name, job.recipe, number, record["model_id"])
                self._ledger.add(model)

    def _end_of(self, job: Thing, deadline: float) -> dict[str, Any] | None:
        while True:
            answer = self._api.read(job.path)
            if answer.status_code != 200:
                self._report(f"{job.path} ({job.name}) was accepted and is {answer.status_code}")
                return None
            record: dict[str, Any] = answer.json()
            if record["status"] not in ("queued", "running"):
                return record
            if time.monotonic() > deadline:
                self._report(f"{job.path} ({job.name}) does not end: {record}")
                return None
            time.sleep(0.2)

    def lists(self) -> None:
        """Hold the lists against the ledger: what is there once, what may be, what may not."""
        known: dict[tuple[str, str], Thing] = {(t.kind, t.name): t for t in self._ledger.things}
        for kind in KINDS:
            found = Counter(item["name"] for item in self._api.listed(kind))
            for name, count in found.items():
                thing = known.get((kind, name))
                if count > 1:
                    self._report(f"{count} {kind} are called {name}, which was made once")
                elif thing is None and not (kind == "models" and ("fits", name) in known):
                    self._report(f"nobody made {name} of the {kind}")
                elif thing is not None and thing.deletion == "accepted":
                    self._report(f"{thing.path} ({name}) was deleted and is listed")
            for thing in self._ledger.kept(kind):
                if found[thing.name] != 1:
                    self._report(f"{thing.path} ({thing.name}) is lost")

    def contents(self, number: int, random: Random) -> None:
        """Read everything of a round again, and some older things."""
        kept = self._ledger.kept(*KINDS)
        older = [thing for thing in kept if thing.round < number]
        new = [thing for thing in kept if thing.round >= number]
        self.read([*new, *random.sample(older, min(SAMPLE, len(older)))])
        gone = [t for t in self._ledger.things if t.identifier and t.deletion == "accepted"]
        for thing in random.sample(gone, min(SAMPLE, len(gone))):
            if (status := self._api.read(thing.path).status_code) != 404:
                self._report(f"{thing.path} ({thing.name}) was deleted and is {status}")

    def everything(self) -> None:
        """Read everything that is kept, and ask for everything that was deleted."""
        self.read(self._ledger.kept(*KINDS))
        self.contents(0, Random(0))  # noqa: S311
        self.lists()

    def read(self, things: Iterable[Thing]) -> None:
        """Read what things hold: the same as all others of their recipe."""
        for thing in things:
            if thing.kind in ("fits", "lifts") and thing.outcome != "succeeded":
                continue
            path = thing.path + FILES[thing.kind]
            answer = self._api.read(path)
            self.counts["contents read"] += 1
            if answer.status_code != 200:
                self._report(f"{path} ({thing.name}): {answer.status_code} {answer.text[:300]}")
                continue
            data = _arrays(answer.content) if thing.kind == "datasets" else answer.content
            if self._ledger.differs((thing.kind, thing.recipe), digest_of(data)):
                self._report(f"{path} ({thing.name}) holds something else than others like it")

    def sweep(self, settings: StoreSettings, kills: int) -> None:
        """Delete what nothing points to, as if a day had passed; and nothing may be missed."""
        store = Store(settings)
        try:
            swept = housekeeping.sweep(store, orphan_seconds=-1, grace_seconds=-1)
            left = housekeeping.sweep(store, orphan_seconds=-1, grace_seconds=-1)
        finally:
            store.close()
        self.counts["objects swept"] += swept.deleted
        if left != (0, 0):
            self._report(f"a second sweep found {left}")
        if swept.condemned > 4 * kills:
            self._report(f"{swept.condemned} objects without a record after {kills} interruptions")

    def find_queued(self, number: int) -> None:
        """Learn which jobs on the queue were recorded; those of a queue that was wiped may not."""
        for job in [t for t in self._ledger.things if t.round == number and t.job_id is not None]:
            self._find(job, 3.0 if job.may_be_lost else FOUND_SECONDS)
            if job.identifier is None and not job.may_be_lost:
                self._report(f"job {job.job_id} ({job.name}) on the queue was never recorded")

    def _find(self, job: Thing, patience: float) -> None:
        deadline = time.monotonic() + patience
        kind: Kind = job.kind
        while job.identifier is None and time.monotonic() < deadline:
            found = self._api.read(f"/{kind}", params={"job_id": job.job_id}).json()["items"]
            if found:
                job.identifier = found[0]["id"]
                return
            time.sleep(0.5)


def _arrays(npz: bytes) -> bytes:
    with np.load(io.BytesIO(npz)) as arrays:
        return save({name: np.ascontiguousarray(arrays[name]) for name in ("keypoints",)})
