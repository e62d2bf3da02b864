"""Drawn captures in a pool of processes: what the benchmarks of many draws share."""

import argparse
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

from benchmarks.drawn_captures import Draw, draw_capture
from benchmarks.motions import SETTING
from benchmarks.moving_captures import ANY, KINDS, draw_moving
from models.numerics.threads import use_threads

Job = TypeVar("Job")
Found = TypeVar("Found")
FAILURES = (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose draws, and how they are measured."""
    parser.add_argument("--draws", type=int, nargs=2, default=(0, 60), help="first and end")
    parser.add_argument("--only", type=int, nargs="+", help="these draws alone")
    parser.add_argument("--data", type=Path, help="folder of captures with `points3d`")
    parser.add_argument(
        "--kind", choices=(*KINDS, ANY), help=f"cameras that move so; {SETTING} if no half is given"
    )
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write the results to this file")


def of_draws(
    measure: Callable[[Draw, argparse.Namespace], Found | None],
    arguments: argparse.Namespace,
    half: str | None,
) -> Iterator[Found]:
    """Yield what a function of a module measures of each draw."""
    numbers = arguments.only or range(*arguments.draws)
    return in_pool(partial(_of_draw, measure, arguments, half), numbers, arguments.processes)


def in_pool(
    measure: Callable[[Job], Found | None], jobs: Iterable[Job], processes: int
) -> Iterator[Found]:
    """Yield what comes of each job, in their order; print the reason where one fails."""
    with get_context("spawn").Pool(processes, _quiet) as pool:
        for found in pool.imap(partial(_tried, measure), jobs):
            if found is not None:
                yield found


def _of_draw(
    measure: Callable[[Draw, argparse.Namespace], Found | None],
    arguments: argparse.Namespace,
    half: str | None,
    number: int,
) -> Found | None:
    if arguments.kind:
        moving = draw_moving(number, arguments.data, half or SETTING, arguments.kind)
        return measure(moving, arguments)
    draw = draw_capture(number, arguments.data, half)
    return None if draw is None else measure(draw, arguments)


def _tried(measure: Callable[[Job], Found | None], job: Job) -> Found | None:
    try:
        return measure(job)
    except FAILURES:
        print(f"{job}: {traceback.format_exc()}", flush=True)
        return None


def _quiet() -> None:
    warnings.simplefilter("ignore")
    use_threads(1)
