"""How the service bears many clients at once: requests closed- and open-loop, streams, memory.

    python benchmarks/load.py [--only requests processes outage streams memory]
                              [--capture FILE.npz] [--model FILE]
                              [--clients 1 2 8 32 64] [--rates 200 400] [--json FILE]

This process sends and waits, nothing else; the service's processes do the work.
README.md says what each row is.
"""

import argparse
import gc
from collections.abc import Callable, Coroutine
from typing import Any

import uvloop

from benchmarks.captures import Float32, add_options, from_options, model_from_options
from benchmarks.clients import measure_requests
from benchmarks.figures import Bar, Results, Row, command
from benchmarks.memory import measure_memory
from benchmarks.outage import measure_outage
from benchmarks.processes import measure_processes
from benchmarks.service_rig import Service, service
from benchmarks.streams import measure_streams
from models.numerics.threads import use_threads

Measured = tuple[dict[str, list[Row]], list[Bar]]
Case = Callable[[Service, str, Float32, argparse.Namespace], Coroutine[Any, Any, Measured]]
CASES: dict[str, Case] = {
    "requests": measure_requests,
    "processes": measure_processes,
    "outage": measure_outage,
    "streams": measure_streams,
    "memory": measure_memory,
}


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    use_threads(1)
    capture = from_options(arguments)
    prior = model_from_options(arguments, capture)
    gc.collect()
    gc.freeze()  # the generator's own pauses would count as the service's
    tables: dict[str, list[Row]] = {}
    bars: list[Bar] = []
    for name in arguments.only:
        with service() as running:  # anew: what one case leaves behind must not burden the next
            model = running.import_model(prior)
            found = uvloop.run(CASES[name](running, model, capture.keypoints, arguments))
        tables |= found[0]
        bars += found[1]
    Results("load", vars(arguments), tables, bars).publish(arguments.json)


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Measure the service under load.")
    add_options(parser)
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 2, 8, 32, 64])
    parser.add_argument("--seconds", type=float, default=10, help="for each number of clients: 10")
    parser.add_argument("--rates", type=float, nargs="+", help="frames/s; default: shares of most")
    parser.add_argument("--processes", type=int, default=2, help="of the API, against one: 2")
    parser.add_argument("--locked-seconds", type=float, default=30, help="of `outage`: 30")
    parser.add_argument("--stream-seconds", type=float, default=60, help="default: 60")
    parser.add_argument(
        "--stream-lag", type=int, help="frames; streams too whose frames are smoothed in time"
    )
    parser.add_argument("--lifts", type=int, default=10_000, help="of `memory`: %(default)s")
    return parser.parse_args()


if __name__ == "__main__":
    main()
