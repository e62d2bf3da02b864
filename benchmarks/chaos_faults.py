"""What goes wrong: each fault is done to a deployment for some seconds, and then is over."""

import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from random import Random

from redis import Redis
from redis.exceptions import RedisError

from benchmarks.chaos_deployments import LEASE_SECONDS, Deployment
from benchmarks.chaos_parts import family, send
from benchmarks.chaos_proxy import Mode

LONGEST_SECONDS = 30.0
RESTART_SECONDS = 3.0
HOUR = 3600.0
OUTAGES: tuple[Mode, ...] = ("refusing", "stalled", "unavailable")

Fault = Callable[[Deployment, Random, float], None]
Processes = Callable[[Deployment], Sequence[int]]


def kill(which: Processes) -> Fault:
    """Return the fault that one of some processes is killed."""

    def fault(deployment: Deployment, random: Random, _seconds: float) -> None:
        if pids := which(deployment):
            send(signal.SIGKILL, random.choice(pids))

    return fault


def kill_everything(deployment: Deployment, _random: Random, _seconds: float) -> None:
    """Kill APIs, workers and queue at a time: a loss of power, but for the servers."""
    for which in (deployment.serving, deployment.workers, deployment.queues, deployment.apis):
        send(signal.SIGKILL, *which())


def freeze(which: Processes) -> Fault:
    """Return the fault that one of some processes stands still for a time."""

    def fault(deployment: Deployment, random: Random, seconds: float) -> None:
        pids = which(deployment)
        if pids:
            frozen = random.choice(pids)
            send(signal.SIGSTOP, frozen)
            time.sleep(seconds)
            send(signal.SIGCONT, frozen)

    return fault


def freeze_worker(deployment: Deployment, random: Random, seconds: float) -> None:
    """Freeze a worker and its job, for less or for more than a lease."""
    workers = deployment.workers()
    if workers:
        worker = random.choice(workers)
        frozen = [worker, *(family(worker) - {worker})]
        send(signal.SIGSTOP, *frozen)
        time.sleep(max(seconds, random.choice((0.5, 1.5)) * LEASE_SECONDS))
        send(signal.SIGCONT, *reversed(frozen))


def drain(which: Processes) -> Fault:
    """Return the fault in which one of some processes gets SIGTERM, and is started again."""

    def fault(deployment: Deployment, random: Random, _seconds: float) -> None:
        if pids := which(deployment):
            send(signal.SIGTERM, random.choice(pids))

    return fault


def wipe(deployment: Deployment, _random: Random, _seconds: float) -> None:
    """Have the queue forget everything."""
    with suppress(RedisError, IndexError), Redis.from_url(deployment.redis_url()) as client:
        client.flushall()


def records_away(deployment: Deployment, random: Random, seconds: float) -> None:
    """Keep the records away."""
    deployment.records_away(random.choice(OUTAGES), seconds)


def objects_away(deployment: Deployment, random: Random, seconds: float) -> None:
    """Keep the objects away."""
    deployment.objects_away(random.choice(OUTAGES), seconds)


def disk_full(deployment: Deployment, _random: Random, seconds: float) -> None:
    """Have no room for anything new."""
    deployment.disk_full(seconds)


def clock_off(deployment: Deployment, random: Random, _seconds: float) -> None:
    """Have a worker killed and started again with a clock that is an hour off."""
    workers = deployment.workers()
    with deployment.clocks.off(random.choice((-HOUR, HOUR))):
        if workers:
            send(signal.SIGKILL, random.choice(workers))
        time.sleep(RESTART_SECONDS)


def draw_seconds(random: Random) -> float:
    """Draw how long a fault lasts: mostly some seconds, now and then up to half a minute."""
    return random.uniform(6, LONGEST_SECONDS) if random.random() < 0.15 else random.uniform(0.3, 6)


FAULTS: dict[str, Fault] = {
    "API killed": kill(Deployment.apis),
    "worker killed": kill(Deployment.workers),
    "work-horse killed": kill(Deployment.horses),
    "queue killed": kill(Deployment.queues),
    "everything killed": kill_everything,
    "API frozen": freeze(Deployment.apis),
    "worker frozen": freeze_worker,
    "work-horse frozen": freeze(Deployment.horses),
    "queue frozen": freeze(Deployment.queues),
    "worker drained": drain(Deployment.workers),
    "service drained": drain(Deployment.serving),
    "queue wiped": wipe,
    "records away": records_away,
    "objects away": objects_away,
    "disk full": disk_full,
    "clock off": clock_off,
}
