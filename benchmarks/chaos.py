"""Whether anything is lost: rounds of work in which processes, queue, records and objects fail.

    python benchmarks/chaos.py [--rounds 20] [--seed 1] [--deployment embedded servers]
                               [--minutes M] [--first-round R] [--only FAULT ...] [--folder FOLDER]

Each round people upload, fit, lift, cancel and delete, while faults are injected; then everything
that the service had acknowledged must be there, equal to the bit, and every job must have ended as
it should. Every round has a key of its own; the keys before it, and those of other projects, see
nothing. What does not hold is printed with the seed and the round that it was seen in. README.md
describes the work and the checks.
"""

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from random import Random

from benchmarks.chaos_api import Api
from benchmarks.chaos_checks import Checks
from benchmarks.chaos_deployments import Deployment, Embedded, Servers
from benchmarks.chaos_faults import FAULTS, draw_seconds
from benchmarks.chaos_keys import Keys
from benchmarks.chaos_ledger import Ledger
from benchmarks.chaos_parts import words
from benchmarks.chaos_users import Action, Users
from benchmarks.figures import Bar, Results, Row, command

DEPLOYMENTS: dict[str, type[Deployment]] = {kind.kind: kind for kind in (Embedded, Servers)}
WORK_SECONDS = 6.0  # in which the work of a round is asked for
SWEEP_ROUNDS = 5


class Run:
    """All rounds on one deployment."""

    def __init__(self, kind: str, seed: int, folder: Path) -> None:
        self.violations: list[str] = []
        self.faults: Counter[str] = Counter()
        self.rounds = 0
        self._kind, self._seed = kind, seed
        self._number = 0
        self.deployment = DEPLOYMENTS[kind](folder, self.report)
        self._api = Api(self.deployment.addresses, self.report)
        self._keys = Keys(self.deployment.addresses, self.report)
        self._ledger = Ledger()
        self.users = Users(self._api, self._ledger, self.deployment.redis_url, self.report)
        self.checks = Checks(self._api, self._ledger, self.report)

    def report(self, what: str) -> None:
        """Note something that must not be."""
        where = f"{self._kind}, --seed {self._seed} --first-round {self._number}: "
        self.violations.append(where + what)
        print(f"VIOLATION {where}{what}", flush=True)

    def settle(self) -> None:
        """Start everything and make what the rounds use, undisturbed."""
        self.deployment.start()
        self._keys.begin()
        self._keys.renew(self._api)
        fits = self.users.settle()
        self.checks.ends(-1)
        self.users.use_models(fits)

    def guarded(self, number: int, only: Sequence[str]) -> None:
        """Do a round; a service that does not come back is a violation, too."""
        try:
            self.round(number, only)
        except TimeoutError as error:
            self.report(str(error))

    def round(self, number: int, only: Sequence[str]) -> None:
        """Do the work of one round while one fault or two happen, then check everything."""
        self._number = number
        self._keys.renew(self._api)
        started = time.monotonic()
        random = Random(f"{self._seed} {self._kind} {number}")  # noqa: S311
        names = random.sample(list(only), min(len(only), random.choice((1, 1, 2))))
        drawn = [(random.uniform(0, WORK_SECONDS), name, draw_seconds(random)) for name in names]
        # Drawn last: what is deleted depends on what there is, and so on the rounds before.
        plan = self.users.plan(number, random, WORK_SECONDS)
        ends = started + max(WORK_SECONDS, *(at + seconds for at, _, seconds in drawn))
        with ThreadPoolExecutor(len(plan) + len(drawn) + 1) as threads:
            done = [threads.submit(self.users.lift_now, ends)]
            done += [threads.submit(_later, at, action) for at, action in plan]
            for at, name, seconds in drawn:
                fault_random = Random(random.random())  # noqa: S311
                done.append(threads.submit(self._inject, at, name, seconds, fault_random))
        for one in done:
            one.result()
        self.deployment.wait_until_ready()
        self._find_strays()
        self.checks.find_queued(number)
        self.checks.ends(number)
        self.checks.lists()
        self.checks.contents(number, random)
        self._keys.check(thing for thing in self._ledger.things if thing.round == number)
        if number % SWEEP_ROUNDS == 0:
            kills = sum(self.faults.values())
            self.checks.sweep(self.deployment.store_settings(), kills)
        self.rounds += 1
        faults = ", ".join(f"{name} ({seconds:.1f} s)" for _, name, seconds in drawn)
        took = time.monotonic() - started
        print(f"{self._kind} round {number}: {faults}; {took:.0f} s", flush=True)

    def _inject(self, at: float, name: str, seconds: float, random: Random) -> None:
        time.sleep(at)
        FAULTS[name](self.deployment, random, seconds)
        self.faults[name] += 1
        if name == "queue wiped":
            for thing in self._ledger.things:
                if thing.round == self._number and thing.job_id is not None:
                    thing.may_be_lost = True

    def end(self) -> None:
        """Check everything once more, and end the deployment."""
        self.checks.sweep(self.deployment.store_settings(), sum(self.faults.values()))
        self.checks.everything()
        self.deployment.stop()
        self._find_strays()

    def _find_strays(self) -> None:
        for pid in self.deployment.strays():
            self.report(f"process {pid} ({words(pid)}) outlived who started it")


def _later(seconds: float, action: Action) -> None:
    time.sleep(seconds)
    action()


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="fewview-chaos-"))
    print(f"logs: {folder}", flush=True)
    deadline = time.monotonic() + 60 * arguments.minutes
    runs = {}
    for kind in arguments.deployment:
        runs[kind] = Run(kind, arguments.seed, folder / kind)
        runs[kind].settle()
    try:
        for number in range(arguments.first_round, arguments.first_round + arguments.rounds):
            for run in runs.values():
                if time.monotonic() < deadline:
                    run.guarded(number, arguments.only)
        for run in runs.values():
            run.end()
    except KeyboardInterrupt:
        print("Stopped: what was seen until now follows.", flush=True)
    finally:
        for run in runs.values():
            run.deployment.stop()
    publish(runs, arguments)


def publish(runs: dict[str, Run], arguments: argparse.Namespace) -> None:
    """Print what was done and what was seen; end with status 1 if there was a violation."""
    violations = [one for run in runs.values() for one in run.violations]
    tables: dict[str, list[Row]] = {
        "Faults": [
            {"fault": name} | {kind: run.faults[name] for kind, run in runs.items()}
            for name in FAULTS
        ],
        "Work": [
            {"what": what} | {kind: counted[what] for kind, counted in _counts(runs).items()}
            for what in sorted(set().union(*_counts(runs).values()))
        ],
        "Violations": [{"violation": one} for one in violations],
    }
    bars = [
        Bar(
            "rounds",
            arguments.rounds * len(runs),
            sum(run.rounds for run in runs.values()),
            "",
            True,
        ),
        Bar("violations", 0, len(violations), ""),
    ]
    Results("chaos", vars(arguments), tables, bars).publish(arguments.json)
    sys.exit(bool(violations))


def _counts(runs: dict[str, Run]) -> dict[str, Counter[str]]:
    return {kind: run.users.counts + run.checks.counts for kind, run in runs.items()}


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Have everything fail, and see that nothing is lost.")
    parser.add_argument("--rounds", type=int, default=20, help="on each deployment: %(default)s")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first-round", type=int, default=1, help="to see one again: its number")
    kinds = list(DEPLOYMENTS)
    parser.add_argument("--deployment", nargs="+", choices=kinds, default=kinds)
    parser.add_argument("--minutes", type=float, default=120, help="end sooner: %(default)s")
    parser.add_argument("--only", nargs="+", choices=list(FAULTS), default=list(FAULTS))
    parser.add_argument("--folder", type=Path, help="for data and logs, which are kept")
    return parser.parse_args()


if __name__ == "__main__":
    main()
