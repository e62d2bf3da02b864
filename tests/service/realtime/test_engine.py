"""The lifting engine: answers as the model's own, whoever else asks for what at the same time."""

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models.capture.synthetic import SyntheticCapture
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from service.realtime.engine import REFINED_FRAMES, SLICE_FRAMES, Engine
from service.settings import Settings
from store import models
from store.database import Store
from store.errors import NotFoundError
from store.records import ModelRecord


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    opened = Store(Settings(data_dir=tmp_path))
    yield opened
    opened.close()


@pytest.fixture
def model(store: Store, weights: bytes) -> str:
    return stored(store, weights).id


@pytest.fixture(params=[1, 3], ids=["one thread", "three threads"])
def engine(store: Store, request: pytest.FixtureRequest) -> Iterator[Engine]:
    opened = Engine(store, max_bytes=2**30, threads=request.param)
    yield opened
    opened.close()


@pytest.fixture
def one_thread(store: Store) -> Iterator[Engine]:
    opened = Engine(store, max_bytes=2**30, threads=1)
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def prior(weights: bytes) -> FittedPrior:
    return FittedPrior.from_bytes(weights)


def stored(store: Store, weights: bytes) -> ModelRecord:
    about: dict[str, Any] = {"name": "figure", "views": 3, "keypoints": 16, "frames": 60}
    return models.create(store, weights, config={}, training_curve=[], metrics={}, **about)


def run(clients: Callable[[], Awaitable[Any]]) -> Any:
    async def main() -> Any:
        return await clients()

    return asyncio.run(main())


def check(found: LiftedFrames, expected: LiftedFrames) -> None:
    assert found.status == expected.status
    for name, array in found.arrays.items():
        known = expected.arrays[name]
        np.testing.assert_allclose(array, known, rtol=1e-3, atol=1e-4, err_msg=name)


def test_everyone_gets_his_own_answer(
    engine: Engine, model: str, prior: FittedPrior, capture: SyntheticCapture
) -> None:
    """Clients that ask all at once, of one, two or three frames, in a few different ways."""
    asked: list[tuple[slice, dict[str, Any]]] = []
    for start in range(50):
        frames = slice(start, start + 1 + start % 3)
        refine = ("off", "full", "auto")[start % 7 % 3]
        views = [2, 0] if start % 5 == 0 else [0, 1, 2]
        weighted = start % 2 == 0
        asked.append((frames, {"refine": refine, "views": views, "weighted": weighted}))

    def arguments(frames: slice, refine: str, views: list[int], weighted: bool) -> dict[str, Any]:
        confidence = capture.confidence[frames][:, views] if weighted else None
        return {"refine": refine, "views": views, "confidence": confidence}

    def pixels(frames: slice, how: dict[str, Any]) -> Any:
        return capture.keypoints[frames][:, how["views"]]

    async def clients() -> list[LiftedFrames]:
        return await asyncio.gather(
            *(
                engine.lift(
                    engine.models.get("default", model),
                    pixels(frames, how),
                    **arguments(frames, **how),
                )
                for frames, how in asked
            )
        )

    for (frames, how), found in zip(asked, run(clients), strict=True):
        check(found, prior.lift(pixels(frames, how), **arguments(frames, **how)))


@pytest.mark.parametrize("refine", ["off", "full"])
def test_slices_are_put_together_in_their_order(
    engine: Engine, model: str, prior: FittedPrior, capture: SyntheticCapture, refine: Any
) -> None:
    frames = 2 * SLICE_FRAMES + 5 if refine == "off" else 2 * REFINED_FRAMES + 5
    keypoints = np.resize(capture.keypoints, (frames, *capture.keypoints.shape[1:]))

    async def client() -> LiftedFrames:
        return await engine.lift(engine.models.get("default", model), keypoints, refine=refine)

    check(run(client), prior.lift(keypoints, refine=refine))


def test_small_calls_overtake_large_ones(
    one_thread: Engine, model: str, capture: SyntheticCapture
) -> None:
    ended: list[str] = []

    async def clients() -> None:
        def ask(name: str, frames: int) -> Any:
            shape = (frames, *capture.keypoints.shape[1:])
            answer = one_thread.lift(
                one_thread.models.get("default", model),
                np.resize(capture.keypoints, shape),
                refine="off",
            )
            answer.add_done_callback(lambda _: ended.append(name))
            return answer

        asked = [ask("huge", 40 * SLICE_FRAMES), ask("large", 3 * SLICE_FRAMES)]
        asked += [ask("small", 1), ask("small", 2)]
        await asyncio.gather(*asked)

    run(clients)
    assert ended == ["small", "small", "large", "huge"]


def test_one_bad_call_spoils_no_others(
    one_thread: Engine, model: str, prior: FittedPrior, capture: SyntheticCapture
) -> None:
    keypoints = capture.keypoints[:1]

    async def clients() -> list[Any]:
        asked = [
            one_thread.lift(one_thread.models.get("default", model), pixels)
            for pixels in (keypoints, keypoints * 1e9) * 4
        ]
        return await asyncio.gather(*asked, return_exceptions=True)

    found = run(clients)
    for good, bad in zip(found[::2], found[1::2], strict=True):
        check(good, prior.lift(keypoints))
        assert isinstance(bad, ValueError)


def test_a_deleted_model_is_served_no_more(
    engine: Engine, model: str, tmp_path: Path, capture: SyntheticCapture
) -> None:
    """However warm it is, who holds it, and whoever deleted it: a second later it is gone."""
    replica = Store(Settings(data_dir=tmp_path))
    held = engine.models.get("default", model)

    async def clients() -> None:
        await engine.lift(held, capture.keypoints)
        models.delete(replica, model)
        deadline = time.monotonic() + 2
        while engine.models.warm("default", model) is not None:
            assert time.monotonic() < deadline
            await asyncio.sleep(0.01)
        with pytest.raises(NotFoundError):
            await engine.lift(held, capture.keypoints[:1])

    run(clients)
    with pytest.raises(NotFoundError):
        engine.models.get("default", model)
    replica.close()


def test_other_weights_are_read_anew(
    engine: Engine, model: str, store: Store, tmp_path: Path, weights: bytes
) -> None:
    replica = Store(Settings(data_dir=tmp_path))
    first = engine.models.get("default", model)
    assert engine.models.get("default", model) is first
    other = stored(replica, weights)
    with replica.writing() as session:
        record = session.get(ModelRecord, model)
        assert record is not None
        record.weights_key = other.weights_key
    assert engine.models.get("default", model) is not first
    replica.close()


def test_a_model_in_use_is_in_memory_once(store: Store, weights: bytes) -> None:
    """Streams hold models for which there would be no room otherwise."""
    engine = Engine(store, max_bytes=0)
    ids = [stored(store, weights).id for _ in range(2)]
    held = engine.models.get("default", ids[0])
    engine.models.get("default", ids[1])
    assert engine.models.warm("default", ids[0]) is held
    del held
    engine.models.get("default", ids[1])
    assert engine.models.warm("default", ids[0]) is None
    engine.close()


class Ending(FittedPrior):
    """A prior whose lifts end the thread that they run in."""

    def lift_observed(self, *_arguments: Any, **_more: Any) -> LiftedFrames:
        raise SystemExit


def test_whatever_happens_in_a_thread_it_answers_and_goes_on(
    one_thread: Engine, model: str, prior: FittedPrior, capture: SyntheticCapture
) -> None:
    sound = one_thread.models.get("default", model)
    ending = Ending.__new__(Ending)
    ending.__dict__.update(prior.__dict__)
    broken = replace(sound, prior=ending)
    many = np.resize(capture.keypoints, (3 * SLICE_FRAMES, *capture.keypoints.shape[1:]))

    async def clients() -> tuple[list[Any], LiftedFrames]:
        asked = [one_thread.lift(broken, keypoints) for keypoints in (capture.keypoints, many)]
        failed = await asyncio.gather(*asked, return_exceptions=True)
        return failed, await one_thread.lift(sound, capture.keypoints)

    failed, found = asyncio.run(asyncio.wait_for(clients(), 60))
    assert [type(error) for error in failed] == [RuntimeError, RuntimeError]
    check(found, prior.lift(capture.keypoints))
