"""The whole job by ``fewview.Client`` and by ``fewview.AsyncClient``, on a served process."""

import asyncio
import subprocess
import sys
from collections.abc import Coroutine
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

import fewview
import numpy as np
import pytest
from fewview import AsyncClient, Client
from fewview.api import datasets
from fewview.api.forms import Fit
from fewview.api.stream_messages import Answer, Dropped
from fewview.api.watching import OpenStream, WatchedFrame
from fewview.calibration import from_model
from fewview.room import to_room
from safetensors.numpy import load_file

from tests.client.conftest import Served, a_capture
from tests.service.conftest import CONFIG
from tests.waiting import wait_for

T = TypeVar("T")
FIXTURES = Path(__file__).parent.parent / "fixtures"
# What is promised to users: changed on purpose, or not at all.
SURFACE = [
    "Animation",
    "ApiError",
    "AsyncClient",
    "Capture",
    "Client",
    "Conflict",
    "ConnectionFailed",
    "FewviewError",
    "Forbidden",
    "FormatError",
    "InvalidRequest",
    "JobFailed",
    "Lift",
    "NotFound",
    "TooManyRequests",
    "Unauthorized",
    "Unavailable",
    "read",
    "write",
]


def awaited(coroutine: Coroutine[Any, Any, T]) -> T:
    return asyncio.run(coroutine)


def test_what_fewview_offers_is_loaded_when_it_is_used() -> None:
    assert sorted(fewview.__all__) == sorted(SURFACE)
    for name in SURFACE:
        assert getattr(fewview, name).__name__ == name
    assert set(fewview.__all__) <= set(dir(fewview))
    with pytest.raises(AttributeError, match="no attribute 'Clients'"):
        fewview.Clients  # noqa: B018
    code = "import sys, fewview; print({'numpy', 'httpx2', 'websockets'} & sys.modules.keys())"
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert ran.stdout == "set()\n"


def test_the_url_is_given_or_in_the_environment_or_the_usual(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("FEWVIEW_URL", raising=False)
    assert Client().url == "http://127.0.0.1:8000"
    monkeypatch.setenv("FEWVIEW_URL", "https://lab.example/fewview/")
    assert Client().url == "https://lab.example/fewview"
    assert Client("http://here:1").url == "http://here:1"
    with pytest.raises(ValueError, match="expected a URL"):
        Client("here:1")


def test_a_dataset_is_stored_described_listed_extended_and_deleted(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, capture = served.client, served.capture
    assert served.dataset.frames == len(capture.keypoints)
    assert served.dataset.raw["metadata"] == {"subject": "M7"}
    assert served.dataset.raw["image_sizes"] == [[1280, 1024], None, [1280, 1024]]
    assert served.dataset.raw["skeleton"]["keypoint_names"][8] == "k8"

    monkeypatch.setattr(datasets, "PART_FRAMES", 25)  # in three requests
    other = client.datasets.create(capture, name="other", fps=50)
    assert other.raw["fps"] == 50
    assert other.checksum == served.dataset.checksum
    longer = client.datasets.append(other, capture.keypoints[:10])
    assert longer.frames == other.frames + 10
    assert client.datasets.get(other.id) == longer
    longer = client.datasets.update(other, name="longer", metadata={"subject": "M8"})
    assert longer.raw["metadata"] == {"subject": "M8"}
    client.datasets.update(other, name="other")
    assert [found.name for found in client.datasets.list(name="other", limit=1)] == ["other"]
    found = [dataset.id for dataset in client.datasets.list(limit=1)]  # a page each
    assert found == [other.id, served.dataset.id]
    client.datasets.delete(other)
    with pytest.raises(fewview.NotFound):
        client.datasets.delete(other)
    with pytest.raises(fewview.NotFound) as error:
        client.datasets.get(other.id)
    assert error.value.status == 404
    assert error.value.code == "not_found"


def test_a_long_capture_that_is_refused_midway_leaves_nothing(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(datasets, "PART_FRAMES", 25)
    before = [dataset.id for dataset in served.client.datasets.list()]
    broken = served.capture.keypoints.copy()
    broken[30] = np.inf
    with pytest.raises(fewview.InvalidRequest) as error:
        served.client.datasets.create(broken)
    assert error.value.errors[0].pointer.startswith("/keypoints")
    assert [dataset.id for dataset in served.client.datasets.list()] == before


def test_a_fit_is_followed_and_its_reconstruction_is_arrays(served: Served) -> None:
    client, heard = served.client, list[Fit]()
    fit = client.fits.create(served.dataset, name="again", **CONFIG, refine="off")
    done = client.fits.wait(fit, on_progress=heard.append)
    assert done.status == "succeeded"
    assert heard[-1] == done
    assert heard[-1].progress is not None
    assert len({job.raw["progress"] and job.raw["progress"]["step"] for job in heard}) > 1
    assert client.fits.wait(fit) == done
    assert next(client.fits.list(status="succeeded")) == done

    lift = client.fits.reconstruction(done)
    frames, views, keypoints = served.capture.keypoints.shape[:3]
    assert len(lift) == frames
    assert lift.points3d.shape == (frames, keypoints, 3)
    assert lift.rotations.shape == (frames, views, 3, 3)
    assert lift.frame_findings is not None
    assert lift.frame_findings.shape == (frames,)
    assert lift.outlier_probability is not None
    assert lift.outlier_probability.shape == (frames, views, keypoints)
    assert lift.quality is not None
    assert lift.quality.shape == (frames,)
    assert lift.quality_reason is not None
    assert lift.quality_reason.shape == (frames,)
    assert lift.lifted.all()
    assert lift.model_id == done.model_id


def test_a_fit_that_fails_is_an_exception(served: Served) -> None:
    unseen = np.full((40, 2, 16, 2), np.nan)
    dataset = served.client.datasets.create(unseen)
    fit = served.client.fits.create(dataset, **CONFIG)
    with pytest.raises(fewview.JobFailed) as error:
        served.client.fits.wait(fit)
    assert error.value.code == "unusable_capture"
    assert error.value.message in str(error.value)
    assert error.value.job.id == fit.id
    served.client.fits.delete(fit)

    fit = served.client.fits.create(served.dataset, **CONFIG | {"steps": 100_000})
    assert served.client.fits.cancel(fit).raw["cancel_requested"]
    with pytest.raises(fewview.JobFailed, match="cancelled"):
        served.client.fits.wait(fit)


def test_errors_name_the_place_of_the_fault(served: Served) -> None:
    with pytest.raises(fewview.InvalidRequest) as error:
        served.client.fits.create(served.dataset, steps=-1)
    assert [item.pointer for item in error.value.errors] == ["/config/steps"]
    with pytest.raises(fewview.InvalidRequest, match="keypoints"):
        served.client.lift(served.model, served.capture.keypoints[:, :, :5])
    with pytest.raises(fewview.Conflict):
        served.client.fits.cancel(served.fit)


def test_models_have_cameras_and_frames_are_lifted(served: Served) -> None:
    client, capture = served.client, served.capture
    model = client.models.get(served.model)
    assert next(client.models.list()).id
    assert model.views == 3
    cameras = client.models.cameras(model)
    assert cameras.arrangement in ("moving", "unknown")
    for view in cameras.views:
        assert view.focal is None or view.focal.shape == (2,)

    alias = client.models.set_alias("walk@production", model)
    assert list(client.models.aliases(model)) == [alias]
    assert client.models.get("walk@production") == model
    assert client.lift("walk@production", capture.keypoints[:1]).model_id == model.id
    client.models.delete("walk@production")
    assert list(client.models.aliases()) == []

    lift = client.lift(model, capture, refine="off")
    assert lift.points3d.shape == (60, capture.keypoints.shape[2], 3)
    two = client.lift(model, capture.keypoints[:4, [2, 0]], views=[2, 0], refine="off")
    assert two.rotations.shape == (4, 2, 3, 3)
    assert {"points3d", "camera_models"} <= two.arrays().keys()


def test_a_dataset_is_lifted_as_a_job(served: Served, tmp_path: Path) -> None:
    client = served.client
    job = client.lifts.wait(client.lifts.create(served.model, served.dataset, refine="off"))
    assert job.progress is not None
    assert job.progress.frames_done == job.frames == 60
    lift = client.lifts.result(job)
    file = client.lifts.download(job, tmp_path / "result.npz")
    with np.load(file) as arrays:
        np.testing.assert_array_equal(arrays["points3d"], lift.points3d)
    assert client.lifts.download(job, tmp_path / "r.jsonl").read_text().count("\n") == 60
    with pytest.raises(ValueError, match="expected a file ending"):
        client.lifts.download(job, tmp_path / "result.txt")
    assert [found.id for found in client.lifts.list(model_id=served.model)] == [job.id]


def test_frames_are_streamed(served: Served) -> None:
    capture = served.capture
    assert capture.confidence is not None
    with served.client.stream(served.model, refine="off") as stream:
        assert stream.ready.keypoints == capture.keypoints.shape[2]
        answer = stream.lift(capture.keypoints[0], confidence=capture.confidence[0])
        assert answer.lifted
        whole = served.client.lift(served.model, capture, refine="off")
        np.testing.assert_allclose(answer.points3d, whole.points3d[0], atol=1e-5)
        np.testing.assert_allclose(answer.views["rotations"], whole.rotations[0], atol=1e-5)
        with pytest.raises(fewview.InvalidRequest, match="keypoints"):
            stream.lift(capture.keypoints[0, :, :3])
        sent = [stream.send(frame) for frame in capture.keypoints[:5]]
        answers = [stream.receive() for _ in sent]
        assert [found.sequence for found in answers if isinstance(found, Answer)] == sent
    with pytest.raises(fewview.NotFound), served.client.stream("mdl_none"):
        pass


def test_a_stream_of_another_is_watched(served: Served) -> None:
    client, frames = served.client, served.capture.keypoints
    wait_for(lambda: not client.streams.list(), "streams of other tests to end", 10)
    with ExitStack() as opened:
        stream = opened.enter_context(client.stream(served.model, refine="off"))
        (mine,) = wait_for(client.streams.list, "the stream to be listed", 10)
        assert (mine.model, mine.key_id, mine.keypoints) == (served.model, "owner", 16)
        with client.watch(mine) as watched:
            found = None
            while not isinstance(found, WatchedFrame):
                answer = stream.lift(frames[3])
                found = next(watched)
            np.testing.assert_array_equal(found.keypoints, frames[3])
            np.testing.assert_array_equal(found.answer.points3d, answer.points3d)
            assert found.answer.points3d_sd is not None
            assert isinstance(awaited(first_seen(served)), OpenStream)
            opened.close()
            assert all(isinstance(last, OpenStream | WatchedFrame) for last in watched)  # it ends
    with client.watch(mine) as watched, pytest.raises(fewview.NotFound, match="may have ended"):
        next(watched)


async def first_seen(served: Served) -> OpenStream | WatchedFrame:
    async with AsyncClient(served.live.url) as client:
        (listed,) = await client.streams.list()
        async with client.watch(listed) as watched:
            return await anext(watched)


def test_answers_come_in_the_room(served: Served, tmp_path: Path) -> None:
    """As `fewview.room` places canonical ones, in the room of the same cameras."""
    client, up = served.client, (0, -1, 0.1)
    model = client.models.upload(FIXTURES / "resting.safetensors")
    keypoints = load_file(FIXTURES / "resting_lifts.safetensors")["keypoints"]
    lift = client.lift(model, keypoints)
    placed = to_room(
        lift.points3d,
        lift.rotations,
        lift.translations,
        lift.camera_models,
        cameras=from_model(client.models.cameras(model).raw),
        reference=None,
        up=up,
    )
    mine = client.lift(model, keypoints, frame="room", up=up)
    np.testing.assert_allclose(mine.points3d, placed.points, atol=1e-4)
    with client.stream(model, frame="room", up=up) as stream:
        answer = stream.lift(keypoints[0])
    np.testing.assert_allclose(answer.points3d, mine.points3d[0], atol=1e-5)
    dataset = client.datasets.create(keypoints)
    job = client.lifts.wait(client.lifts.create(model, dataset, frame="room", up=up))
    assert job.frame == "room"
    np.testing.assert_array_equal(client.lifts.result(job).points3d, mine.points3d)
    with pytest.raises(fewview.Conflict, match="none of its cameras is static"):
        client.fits.reconstruction(served.fit, frame="room")
    np.save(tmp_path / "keypoints.npy", keypoints.swapaxes(0, 1))
    file, command = tmp_path / "out.npz", [sys.executable, "-m", "fewview.cli", "lift", model.id]
    command += [str(tmp_path / "keypoints.npy"), "-o", str(file), "--frame=room", "--up=0,-1,0.1"]
    ran = subprocess.run([*command, f"--url={client.url}"], capture_output=True, check=False)
    assert ran.returncode == 0, ran.stderr
    with np.load(file) as arrays:
        np.testing.assert_allclose(arrays["points3d"], mine.points3d, atol=1e-5)


def test_keys_are_made_and_revoked_and_the_audit_is_read(served: Served) -> None:
    client, tomorrow = served.client, datetime.now(UTC) + timedelta(days=1)
    key = client.keys.create(
        "laptop", ["read", "write"], project="gait", expires_at=tomorrow, queued_jobs=2
    )
    assert key.token not in repr(key)
    assert (key.scopes, key.quotas["queued_jobs"]) == (("read", "write"), 2)
    assert key.expires_at == tomorrow
    with Client(served.live.url, key.token) as other:
        dataset = other.datasets.create(a_capture(4))
        with pytest.raises(fewview.Forbidden):
            next(other.keys.list())
    assert [entry.action for entry in client.audit.list(key=key)] == ["dataset.create"]
    (entry,) = client.audit.list(target=dataset.id)
    assert (entry.key_id, entry.project) == (key.id, "gait")
    client.keys.revoke(key)
    assert client.keys.get(key.id).revoked_at is not None
    assert key.id in [found.id for found in client.keys.list()]
    with Client(served.live.url, key.token) as other, pytest.raises(fewview.Unauthorized):
        next(other.datasets.list())


def test_webhooks_are_made_and_deleted(served: Served) -> None:
    webhooks = served.client.webhooks
    made = webhooks.create("https://lab.example/", ["fit.cancelled"])
    assert made.secret not in repr(made)
    assert webhooks.get(made) == next(webhooks.list())
    assert list(webhooks.deliveries(made)) == []
    with pytest.raises(fewview.InvalidRequest):
        webhooks.create("https://127.0.0.1/")
    webhooks.delete(made)
    assert list(webhooks.list()) == []


def test_the_same_can_be_awaited(served: Served, tmp_path: Path) -> None:
    async def job() -> None:
        async with AsyncClient(served.live.url) as client:
            assert (await client.health.ready()).workers == 1
            assert (await client.health.version()).api == 1
            queues = {found.queue: found for found in (await client.health.queues()).items}
            assert queues["fits"].workers == 1
            dataset = await client.datasets.create(a_capture(20), name="awaited")
            storage = await client.health.storage()
            assert storage.stored_bytes == sum(kind.stored_bytes for kind in storage.items) > 0
            assert dataset.id in {item.id for item in storage.largest}
            heard: list[Fit] = []
            fit = await client.fits.create(dataset, **CONFIG, refine="off")
            fit = await client.fits.wait(fit, on_progress=heard.append)
            assert heard[-1] == fit
            assert fit.model_id is not None
            assert len(await client.fits.reconstruction(fit)) == 20
            assert dataset.id in [found.id async for found in client.datasets.list(limit=2)]
            frames = served.capture.keypoints[:8]
            lifts = await asyncio.gather(*(client.lift(fit.model_id, frames) for _ in range(4)))
            np.testing.assert_array_equal(lifts[0].points3d, lifts[3].points3d)
            weights = await client.models.download(fit.model_id, tmp_path / "weights")
            copy = await client.models.upload(weights, name="copy")
            await client.models.delete(copy)
            with pytest.raises(fewview.NotFound):
                await client.models.get(copy.id)
            async with client.stream(fit.model_id, on_overload="latest") as stream:
                answer = await stream.lift(frames[0])
                assert answer.lifted
                last = [await stream.send(frame) for frame in frames][-1]
                async for found in stream:
                    assert isinstance(found, Answer | Dropped)
                    if isinstance(found, Answer) and found.sequence == last:
                        break

    awaited(job())


def test_a_wait_that_is_given_up_leaves_no_connection(served: Served) -> None:
    async def give_up() -> None:
        async with AsyncClient(served.live.url) as client:
            fit = await client.fits.create(served.dataset, **CONFIG | {"steps": 100_000})
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(1):
                    await client.fits.wait(fit)
            await client.fits.cancel(fit)

    awaited(give_up())
