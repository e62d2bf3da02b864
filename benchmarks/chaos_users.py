"""What people do in a round, whatever goes wrong meanwhile."""

import time
import uuid
from collections import Counter
from collections.abc import Callable
from functools import partial
from random import Random
from typing import Any

import numpy as np
from redis import Redis
from redis.exceptions import RedisError
from rq import Queue
from safetensors.numpy import save

from benchmarks.chaos_api import PATIENCE_SECONDS, Api
from benchmarks.chaos_ledger import Kind, Ledger, Thing, digest_of
from models.capture.synthetic import synthetic_capture

BYTES = {"Content-Type": "application/octet-stream"}
SMALL, LONG = 40, 500  # frames
CONFIG: dict[str, Any] = {
    "dictionary_sizes": [16, 8],
    "batch_size": 16,
    "cameras": "moving",
    "refine": "off",
}
STEPS = (60, 300, 900)  # of fits: some are over before a fault, some are not
KEPT: dict[Kind, int] = {
    "datasets": 12,
    "models": 12,
    "fits": 12,
    "lifts": 8,
}  # beyond which some are deleted
EVERY_SECONDS = 0.2  # real-time lifts
Action = Callable[[], object]
CAPTURES = {
    "first": synthetic_capture(frames=SMALL, views=3, noise=1.0, seed=11).keypoints,
    "second": synthetic_capture(frames=SMALL, views=3, noise=1.0, seed=12).keypoints,
    "long": synthetic_capture(frames=LONG, views=3, noise=1.0, seed=13).keypoints,
    "empty": np.full((3, 3, 16, 2), np.nan, np.float32),
}


class Users:
    """People who upload, fit, lift, cancel and delete, and note what they were promised."""

    def __init__(
        self,
        api: Api,
        ledger: Ledger,
        redis_url: Callable[[], str],
        report: Callable[[str], None],
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._api, self._ledger, self._report = api, ledger, report
        self._redis_url = redis_url
        self._base: dict[str, Thing] = {}
        self._models: list[tuple[str, str]] = []  # identifiers of models and their recipes
        self._round = -1  # of what is made before the first

    def settle(self) -> list[Thing]:
        """Store what later rounds use and never delete; return the fits whose models they need."""
        for capture in CAPTURES:
            self._base[capture] = self.upload(f"base-{capture}", capture)
        return [self.fit(f"base-{name}", name, STEPS[0]) for name in ("first", "second")]

    def use_models(self, fits: list[Thing]) -> None:
        """Lift with the models of fits that have ended."""
        for fit in fits:
            model = self._api.read(fit.path).json()["model_id"]
            self._models.append((model, str(fit.recipe)))

    def plan(self, number: int, random: Random, seconds: float) -> list[tuple[float, Action]]:
        """Draw what is done in a round: pairs of seconds from its start and an action."""
        self._round = number
        names = (f"r{number}-{count}" for count in range(100))
        capture = random.choice(("first", "second"))
        steps = random.choices(STEPS, (5, 3, 1), k=2)
        lifted = [(*random.choice(self._models), random.choice(("off", "auto"))) for _ in range(2)]
        upload = partial(self.upload, next(names), capture, cut=random.choice((0, 0, SMALL // 2)))
        drawn: list[tuple[float, Action]] = [  # each with its probability
            (1.0, upload),
            (1.0, partial(self.fit, next(names), capture, steps[0])),
            (1.0, partial(self.lift, next(names), *lifted[0])),
            (0.5, partial(self.queue_fit, next(names), capture, steps[1])),
            (0.4, partial(self.queue_lift, next(names), *lifted[1])),
            (0.1, partial(self.fit, next(names), "empty", STEPS[0], "failed")),
            (0.5, partial(self.cancel, number, random.random())),
        ]
        actions = [action for probability, action in drawn if random.random() < probability]
        return [(random.uniform(0, seconds), one) for one in actions + self._deletions(random)]

    def _deletions(self, random: Random) -> list[Action]:
        """Choose things of earlier rounds to delete: one of each kind, and what is too many."""
        chosen: list[Thing] = []
        for kind, most in KEPT.items():
            old = [thing for thing in self._ledger.kept(kind) if 0 <= thing.round < self._round]
            chosen += random.sample(old, min(len(old), max(0, len(old) - most) + 1))
        return [partial(self.delete, thing) for thing in chosen]

    def _make(self, thing: Thing, path: str, **options: Any) -> None:
        headers = {"Idempotency-Key": f"{thing.name}-{path}"} | options.pop("headers", {})
        self._ledger.add(thing)
        answer = self._api.ask("POST", path, headers=headers, **options)
        if answer is None:
            self.counts["requests that were never answered"] += 1
        elif answer.status_code in (201, 202):
            thing.identifier = answer.json()["id"]
            self.counts[f"{thing.kind} made by HTTP"] += 1
        else:
            self._report(f"POST {path} of {thing.name}: {answer.status_code} {answer.text[:300]}")

    def upload(self, name: str, capture: str, *, cut: int = 0) -> Thing:
        """Store a capture, in one piece or in two."""
        pixels = CAPTURES[capture]
        thing = Thing("datasets", name, ("capture", capture), self._round)
        first = save({"keypoints": pixels[: cut or None]})
        if cut:
            thing.recipe = ("half", capture)
        self._make(thing, f"/datasets?name={name}", content=first, headers=BYTES)
        if cut and thing.identifier is not None:
            rest = save({"keypoints": np.ascontiguousarray(pixels[cut:])})
            headers = BYTES | {"Idempotency-Key": f"{name}-rest"}
            path = f"{thing.path}/frames"
            answer = self._api.ask("POST", path, content=rest, headers=headers)
            if answer is None:
                thing.recipe = ("either", name)
            elif answer.status_code == 200:
                thing.recipe = ("capture", capture)
                self.counts["frames appended"] += 1
            else:
                self._report(f"POST {path}: {answer.status_code} {answer.text[:300]}")
        return thing

    def fit(self, name: str, capture: str, steps: int, outcome: str = "succeeded") -> Thing:
        """Fit a model."""
        thing = Thing("fits", name, ("fit", capture, steps), self._round, outcome=outcome)
        body = {"dataset_id": self._base[capture].identifier, "name": name}
        self._make(thing, "/fits", json=body | {"config": CONFIG | {"steps": steps}})
        return thing

    def lift(self, name: str, model: str, recipe: str, refine: str) -> Thing:
        """Lift the long capture."""
        thing = Thing("lifts", name, ("lift", recipe, refine), self._round)
        body = {"dataset_id": self._base["long"].identifier, "model_id": model, "name": name}
        self._make(thing, "/lifts", json=body | {"refine": refine})
        return thing

    def queue_fit(self, name: str, capture: str, steps: int) -> None:
        """Put a fit on the queue, as any producer of RQ does."""
        thing = Thing("fits", name, ("fit", capture, steps), self._round)
        config = CONFIG | {"steps": steps}
        dataset = self._base[capture].identifier
        self._enqueue(thing, "worker.jobs.fit", dataset_id=dataset, config=config, name=name)

    def queue_lift(self, name: str, model: str, recipe: str, refine: str) -> None:
        """Put a lift on the queue."""
        thing = Thing("lifts", name, ("lift", recipe, refine), self._round)
        options = {"model_id": model, "dataset_id": self._base["long"].identifier, "name": name}
        self._enqueue(thing, "worker.jobs.lift", **options, refine=refine)

    def _enqueue(self, thing: Thing, function: str, **options: Any) -> None:
        thing.job_id = str(uuid.uuid4())
        self._ledger.add(thing)
        deadline = time.monotonic() + PATIENCE_SECONDS
        while time.monotonic() < deadline:
            try:
                with Redis.from_url(self._redis_url(), socket_timeout=5) as connection:
                    queue = Queue("fits", connection=connection)
                    queue.enqueue(function, kwargs=options, job_id=thing.job_id)
            except (RedisError, IndexError):
                time.sleep(1)
                continue
            self.counts[f"{thing.kind} put on the queue"] += 1
            return
        thing.may_be_lost = True

    def cancel(self, number: int, which: float) -> None:
        """Cancel one of the round's jobs."""
        time.sleep(1)
        jobs = [t for t in self._ledger.kept("fits", "lifts") if t.round == number]
        if not jobs:
            return
        job = jobs[int(which * len(jobs))]
        job.cancel = "tried"
        answer = self._api.ask("POST", f"{job.path}/cancel")
        if answer is not None and answer.status_code == 202:
            job.cancel = "accepted"
            self.counts["jobs cancelled"] += 1
        elif answer is not None and answer.status_code != 409:
            self._report(f"POST {job.path}/cancel: {answer.status_code} {answer.text[:300]}")

    def delete(self, thing: Thing) -> None:
        """Delete something of an earlier round."""
        before, thing.deletion = thing.deletion, "tried"
        answer = self._api.ask("DELETE", thing.path)
        if answer is None:
            return
        if answer.status_code in (204, 404):
            thing.deletion = "accepted"
            self.counts[f"{thing.kind} deleted"] += 1
        elif answer.status_code == 409:
            thing.deletion = before
        else:
            self._report(f"DELETE {thing.path}: {answer.status_code} {answer.text[:300]}")

    def lift_now(self, ends: float) -> None:
        """Lift a few frames in real time, again and again until a time (monotonic)."""
        frames = save({"keypoints": np.ascontiguousarray(CAPTURES["long"][:4])})
        turn = 0
        while time.monotonic() < ends:
            model, recipe = self._models[turn % len(self._models)]
            turn += 1
            path = f"/lift?model={model}&format=safetensors"
            answer = self._api.once("POST", path, content=frames, headers=BYTES)
            if answer is None:
                self.counts["real-time lifts not answered"] += 1
            elif answer.status_code != 200:
                self._report(f"POST {path}: {answer.status_code} {answer.text[:300]}")
            else:
                self.counts["real-time lifts"] += 1
                if self._ledger.differs(("lift now", recipe), digest_of(answer.content)):
                    self._report(f"POST {path}: another answer than before")
            time.sleep(EVERY_SECONDS)
