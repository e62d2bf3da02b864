"""What lifts cost through the service, against warm models, stored frames and workers."""

import argparse
import time

import numpy as np
import orjson
import uvloop

from benchmarks.captures import Float32, fitted, studio
from benchmarks.figures import Bar
from benchmarks.scaling_process import FIT, FRAMES, SHORT, Costs, time_all
from benchmarks.service_rig import Service, service
from benchmarks.wire import Connection, post
from models.settings.config import Refine

JSON = "application/json"
DECADES = (1_000, 10_000, 100_000, 1_000_000)
FEWEST_FRAMES = 10_000  # below, a job's start and end are what its frames cost
LARGEST_FIT = 100_000  # frames
FLAT = 1.2  # times as much still counts as the same
HALVED = 0.6  # of the time with one worker: half, to within a fifth
REFINES: dict[str, Refine] = {"lift job, feed-forward": "off", "lift job, refined": "auto"}
ROUNDS = 4


def measure_models(arguments: argparse.Namespace) -> tuple[Costs, list[Bar]]:
    """Single frames over one connection, each for the next of so many models."""
    capture = studio(frames=FRAMES)
    prior = fitted(capture, SHORT)
    counts = [count for count in (1, 4, 16, 64, 256) if count <= arguments.models]
    with service() as running:
        models = [running.import_model(prior) for _ in range(max(counts))]
        costs = uvloop.run(_ask_in_turn(running, models, counts, capture.keypoints))
    growth = costs[max(counts)] / costs[min(counts)]
    what = f"a request with {max(counts)} warm models against one"
    return {"POST /lift": costs}, [Bar(what, FLAT, growth, "x")]


async def _ask_in_turn(
    running: Service, models: list[str], counts: list[int], keypoints: Float32
) -> dict[float, float]:
    requests = [
        post(
            "/lift",
            orjson.dumps(
                {"model": model, "frames": keypoints[:1], "refine": "off"},
                option=orjson.OPT_SERIALIZE_NUMPY,
            ),
            content=JSON,
            accept=JSON,
        )
        for model in models
    ]
    connection = await Connection.open(running.host, running.port)
    seconds: dict[float, list[float]] = {count: [] for count in counts}
    for turn in range(1 + ROUNDS):
        for count in counts:
            for request in requests[:count] * -(-len(requests) // count):
                started = time.perf_counter()
                answer = await connection.ask(request)
                if answer.status != 200:
                    raise RuntimeError(f"POST /lift answered {answer.status}: {answer.body!r}")
                if turn:
                    seconds[count].append(time.perf_counter() - started)
    connection.close()
    return {count: 1e6 * float(np.median(times)) for count, times in seconds.items()}


def measure_frames(arguments: argparse.Namespace) -> tuple[Costs, list[Bar]]:
    """Lifts of stored datasets by the service's one worker, and steps of fits to many frames."""
    capture = studio(frames=FRAMES)
    prior = fitted(capture, SHORT)
    sizes = [size for size in DECADES if size <= arguments.largest]
    costs: Costs = {name: {} for name in REFINES}
    with service() as running:
        model = running.import_model(prior)
        for size in [sizes[0], *sizes]:  # the first one twice: it warms the worker up
            dataset = running.upload_many(capture.keypoints, size)
            for name, refine in REFINES.items():
                costs[name][size] = 1e6 * _lift_job(running, model, dataset, refine) / size
    few = [size for size in sizes if size <= LARGEST_FIT]
    captures = {size: studio(frames=size) for size in few}
    costs |= time_all(dict.fromkeys(few, prior), captures, arguments.seconds, refines=[])
    bars = []
    for name, by_size in costs.items():
        judged = [size for size in by_size if size >= FEWEST_FRAMES or name == FIT]
        if len(judged) > 1:
            growth = by_size[max(judged)] / by_size[min(judged)]
            what = f"{name}: a frame of {max(judged):,} against one of {min(judged):,}"
            bars.append(Bar(what, FLAT, growth, "x"))
    return costs, bars


def measure_workers(arguments: argparse.Namespace) -> tuple[Costs, list[Bar]]:
    """Refined lifts of one stored dataset by one worker process and by two."""
    capture = studio(frames=FRAMES)
    prior = fitted(capture, SHORT)
    name = "lift job, refined"
    costs: Costs = {name: {}}
    for workers in (1, 2):
        with service("--workers", str(workers)) as running:
            model = running.import_model(prior)
            warming = running.upload_many(capture.keypoints, 2 * FEWEST_FRAMES)
            _lift_job(running, model, warming, "off")
            dataset = running.upload_many(capture.keypoints, arguments.job_frames)
            seconds = _lift_job(running, model, dataset, REFINES[name])
            costs[name][workers] = 1e6 * seconds / arguments.job_frames
    share = costs[name][2] / costs[name][1]
    return costs, [Bar("a lift job with two workers, of one worker's time", HALVED, share, "x")]


def _lift_job(running: Service, model: str, dataset: str, refine: Refine) -> float:
    body = {"model_id": model, "dataset_id": dataset, "refine": refine}
    return running.run("/lifts", body)[1]
