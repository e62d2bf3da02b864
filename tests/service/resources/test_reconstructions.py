"""Reconstructions: of a fit's own frames, stored, and refined otherwise when asked."""

import io
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
from safetensors.numpy import load, save
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture
from models.lifting.fitted_prior import FittedPrior
from models.lifting.frames_json import frames_to_json
from models.lifting.lift import CAMERA_MODELS
from models.settings.uncertainty import ARRAYS
from service.settings import Settings
from store import attempts, fits, records
from store.database import Store
from tests.damage import HARMS
from tests.service.conftest import (
    CONFIG,
    Live,
    assert_can_be_resumed,
    make_dataset,
    problem,
    served,
)


def test_the_reconstruction_is_the_same_in_every_format(
    live: Live, fitted: dict[str, Any], capture: SyntheticCapture
) -> None:
    url = f"/fits/{fitted['id']}/reconstruction"
    data = live.http.get(url)
    assert data.headers["content-type"] == "application/json"
    octets = live.http.get(url, headers={"Accept": "application/octet-stream"})
    assert "safetensors" in octets.headers["content-disposition"]
    arrays = load(octets.content)
    npz = live.http.get(f"{url}?format=npz")
    assert npz.headers["content-type"] == "application/x-npz"
    path = live.data_dir / "reconstruction.npz"
    path.write_bytes(npz.content)
    with np.load(path) as file:
        assert set(file.files) == set(arrays)
        for name in file.files:
            np.testing.assert_array_equal(file[name], arrays[name])

    n, k, p, _ = capture.keypoints.shape
    assert {name: array.shape for name, array in arrays.items()} == {
        "points3d": (n, p, 3),
        "rotations": (n, k, 3, 3),
        "scales": (n, k),
        "translations": (n, k, 3),
        "focals": (n, k, 2),
        "principal_points": (n, k, 2),
        "distortions": (n, k, 8),
        "camera_models": (n, k),
        "reprojection_errors": (n, k),
        "keypoints_used": (n, k),
        "points3d_sd": (n, p),
        "keypoints_seen": (n, p),
        "outlier_probability": (n, k, p),
        "quality": (n,),
        "quality_reason": (n,),
        "findings": (n,),
    }
    perspective = np.any(arrays["camera_models"] > 0, axis=1, keepdims=True)
    known = np.logical_and(np.all(np.isfinite(arrays["points3d"]), axis=-1), perspective)
    assert (arrays["points3d_sd"][known] > 0).all()
    assert np.isnan(arrays["points3d_sd"][~known]).all()
    body = data.json()
    assert body["fit_id"] == fitted["id"]
    assert body["model_id"] == fitted["model_id"]
    assert len(body["frames"]) == n
    for index, frame in enumerate(body["frames"]):
        assert frame["status"] == "ok"
        assert frame["reason"] is None
        judged = np.array(frame["outlier_probability"], np.float32)  # None is NaN
        np.testing.assert_array_equal(judged, arrays["outlier_probability"][index])
        np.testing.assert_array_equal(np.float32(frame["points3d"]), arrays["points3d"][index])
        quality = np.array(frame["quality"], np.float32)
        np.testing.assert_array_equal(quality, arrays["quality"][index])
        off = frame["points3d_sd"]
        off = [None] * p if off is None else off
        np.testing.assert_array_equal(np.array(off, np.float32), arrays["points3d_sd"][index])
        for view, camera in enumerate(frame["views"]):
            if camera is None:
                assert np.isnan(arrays["scales"][index, view])
                assert arrays["camera_models"][index, view] == -1
                continue
            assert camera["camera"] == CAMERA_MODELS[arrays["camera_models"][index, view]]
            for name, plural in (
                ("rotation", "rotations"),
                ("scale", "scales"),
                ("translation", "translations"),
                ("focal", "focals"),
                ("principal_point", "principal_points"),
                ("distortion", "distortions"),
                ("reprojection_error", "reprojection_errors"),
            ):
                value = arrays[plural][index, view]
                if name == "translation" and camera["camera"] == "weak_perspective":
                    value = value[:2]
                if camera[name] is None:
                    assert np.isnan(value).all()
                else:
                    np.testing.assert_array_equal(np.float32(camera[name]), value)
    assert body["frames"][7]["views"][1] is None  # the view that saw nothing
    observed = np.isfinite(capture.keypoints).all(-1) & (capture.confidence > 0)
    np.testing.assert_array_equal(np.isfinite(arrays["outlier_probability"]), observed)
    np.testing.assert_array_equal(arrays["keypoints_used"][0], (capture.confidence[0] > 0).sum(-1))
    problem(live.http.get(url, headers={"Accept": "image/png"}), 406, "not_acceptable")
    problem(live.http.get(f"{url}?format=png"), 422, "invalid_input", "/format")


def test_a_reconstruction_can_be_refined_otherwise(
    live: Live, fitted: dict[str, Any], capture: SyntheticCapture
) -> None:
    url = f"/fits/{fitted['id']}/reconstruction"
    stored = live.http.get(f"{url}?format=safetensors")
    same = live.http.get(f"{url}?format=safetensors&refine={fitted['config']['refine']}")
    assert same.content == stored.content
    weights = live.http.get(f"/models/{fitted['model_id']}/weights").content
    prior = FittedPrior.from_bytes(weights)
    for refine in ("off", "full"):
        answer = live.http.get(f"{url}?format=safetensors&refine={refine}")
        assert answer.status_code == 200, answer.text
        arrays = load(answer.content)
        assert arrays.keys() == load(stored.content).keys()
        here = prior.lift(capture.keypoints, confidence=capture.confidence, refine=refine)
        np.testing.assert_allclose(arrays["points3d"], here.points3d, rtol=1e-4, atol=1e-5)
        np.testing.assert_array_equal(arrays["camera_models"], here.camera_models)
    assert (
        load(live.http.get(f"{url}?format=safetensors&refine=off").content)["camera_models"] <= 0
    ).all()
    problem(live.http.get(f"{url}?refine=some"), 422, "invalid_input", "/refine")


def test_a_reconstruction_has_as_much_of_its_uncertainty_as_is_asked_for(
    live: Live, fitted: dict[str, Any], capture: SyntheticCapture
) -> None:
    url = f"/fits/{fitted['id']}/reconstruction"
    stored = live.http.get(f"{url}?format=safetensors")
    assert live.http.get(f"{url}?format=safetensors&uncertainty=sd").content == stored.content
    arrays = load(stored.content)
    for form in ("npz", "safetensors", "json"):
        for more in ("", "&frames=3:9"):  # as a file that is laid out, and made in memory
            answer = live.http.get(f"{url}?format={form}&uncertainty=off{more}")
            assert answer.status_code == 200, answer.text
            if form == "json":
                frames = answer.json()["frames"]
                assert all(frame["points3d_sd"] is None for frame in frames)
                continue
            read = load if form == "safetensors" else read_npz
            without = read(answer.content)
            assert without.keys() == arrays.keys() - {"points3d_sd"}
            part = slice(3, 9) if more else slice(None)
            for name, array in without.items():
                np.testing.assert_array_equal(array, arrays[name][part])
    full = load(live.http.get(f"{url}?format=safetensors&uncertainty=full").content)
    assert full.keys() == arrays.keys() | ARRAYS["full"].keys()
    prior = FittedPrior.from_bytes(live.http.get(f"/models/{fitted['model_id']}/weights").content)
    here = prior.lift(capture.keypoints, confidence=capture.confidence, uncertainty="full")
    assert np.isfinite(here.points3d_modes).any()
    for name in ("points3d", *ARRAYS["full"]):
        np.testing.assert_allclose(full[name], getattr(here, name), rtol=1e-3, atol=1e-5)
    first = live.http.get(f"{url}?uncertainty=full").json()["frames"][0]
    np.testing.assert_array_equal(
        np.array(first["points3d_covariance"], np.float32), full["points3d_covariance"][0]
    )
    refused = live.http.get(f"{url}?uncertainty=full&frames=3:9")
    assert "what the fit stored" in problem(refused, 422, "invalid_input", "/uncertainty")
    problem(live.http.get(f"{url}?uncertainty=some"), 422, "invalid_input", "/uncertainty")


def read_npz(content: bytes) -> dict[str, Any]:
    with np.load(io.BytesIO(content)) as file:
        return dict(file)


def test_what_is_gone_cannot_be_refined_otherwise(live: Live) -> None:
    dataset = make_dataset(live.http, frames=30)
    fit = live.finished(live.fit(dataset["id"], steps=5)["id"])
    url = f"/fits/{fit['id']}/reconstruction"
    assert live.http.get(f"{url}?refine=off").status_code == 200
    assert live.http.delete(f"/datasets/{dataset['id']}").status_code == 204
    assert dataset["id"] in problem(live.http.get(f"{url}?refine=off"), 404, "not_found")
    assert live.http.delete(f"/models/{fit['model_id']}").status_code == 204
    assert "deleted" in problem(live.http.get(f"{url}?refine=off"), 409, "conflict")
    assert live.http.get(f"{url}?refine=auto").status_code == 200


def stored_fit(
    settings: Settings, dataset: dict[str, Any], reconstruction: bytes, **columns: Any
) -> str:
    """Record a fit that succeeded, without running it; return its identifier."""
    store = Store(settings)
    fit = fits.create(store, dataset_id=dataset["id"], name="f", config=CONFIG)
    attempt = attempts.claim(store, fit.id, lease_seconds=60)
    assert attempt is not None
    attempts.succeed(
        store,
        attempt,
        weights=b"",
        reconstruction=reconstruction,
        progress=columns.pop("progress", None),
        describe={"keypoints": 16, "config": CONFIG, "training_curve": [], "metrics": {}},
    )
    with store.writing() as session:
        for name, value in ({"config": CONFIG} | columns).items():
            setattr(session.get(records.FitRecord, fit.id), name, value)
    store.close()
    return fit.id


def test_records_of_older_versions_are_served(api: TestClient, settings: Settings) -> None:
    """A reconstruction without perspective; progress without a stage."""
    old = {
        "points3d": np.random.default_rng(0).normal(size=(3, 16, 3)),
        "rotations": np.tile(np.eye(3), (3, 2, 1, 1)),
        "scales": np.array([[2.0, np.nan]] * 3),
        "translations": np.array([[[5.0, 6.0], [np.nan, np.nan]]] * 3),
        "reprojection_errors": np.array([[1.0, np.nan]] * 3),
    }
    arrays = {name: array.astype(np.float32) for name, array in old.items()}
    arrays["keypoints_used"] = np.array([[16, 0]] * 3, np.int32)
    progress = {"step": 9, "steps": 9, "loss": 1, "reprojection_error": 1, "seconds_left": 0}
    fit = stored_fit(settings, make_dataset(api), save(arrays), progress=progress)

    assert api.get(f"/fits/{fit}").json()["progress"] == {
        "stage": "training",
        "stopped_by": None,
        **progress,
    }
    for url in (f"/fits/{fit}/reconstruction", f"/fits/{fit}/reconstruction?refine=off"):
        answer = api.get(url)
        assert answer.status_code == 200, answer.text
        for frame in answer.json()["frames"]:
            assert frame["views"][1] is None
            view = frame["views"][0]
            assert (view["camera"], view["translation"]) == ("weak_perspective", [5.0, 6.0])
            assert view["focal"] is None
    found = load(api.get(f"/fits/{fit}/reconstruction?format=safetensors").content)
    assert found["translations"].shape == (3, 2, 3)
    assert found["camera_models"].tolist() == [[0, -1]] * 3
    assert all(found[name].dtype == np.float32 for name in ("translations", "focals"))


@pytest.mark.parametrize("format", ["npz", "safetensors"])
def test_a_stored_reconstruction_is_read_as_it_is_sent(
    api: TestClient, settings: Settings, format: str
) -> None:
    """However long it is, and no more of it than is asked for."""
    shapes = {"points3d": (16, 3), "scales": (2,), "camera_models": (2,)}
    arrays = {name: np.ones((100_000, *shape), np.float32) for name, shape in shapes.items()}
    arrays["camera_models"] = arrays["camera_models"].astype(np.int8)
    fit = stored_fit(settings, make_dataset(api), save(arrays), frames=100_000)
    url = f"/fits/{fit}/reconstruction?format={format}"
    assert api.head(url).status_code == 200
    tracemalloc.start()
    try:
        part = api.get(url, headers={"Range": "bytes=-100"})
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert part.status_code == 206
    whole = api.get(url).content
    assert peak < len(whole) / 4
    assert part.content == whole[-100:]
    found = load(whole) if format == "safetensors" else np.load(io.BytesIO(whole))
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)


def test_as_json_it_is_that_of_its_arrays_however_long_it_is(
    settings: Settings, live: Live, fitted: dict[str, Any]
) -> None:
    stored = live.http.get(f"/fits/{fitted['id']}/reconstruction?format=safetensors").content
    arrays = {name: np.concatenate([array] * 100) for name, array in load(stored).items()}
    arrays["scales"] += np.arange(len(arrays["scales"]))[:, None]  # no frame is like another
    with served(settings) as http:
        fit = stored_fit(settings, make_dataset(http), save(arrays))
        url = f"/fits/{fit}/reconstruction"
        whole = http.get(url)
        names = ("fit_id", "model_id", "dataset_id", "stage")
        fields = {name: whole.json()[name] for name in names}
        texts = [orjson.Fragment(text) for text in frames_to_json(arrays)]
        assert len(texts) == 100 * 60
        assert whole.content == orjson.dumps({**fields, "frames": texts, "findings": []})
        assert http.get(url, headers={"If-None-Match": whole.headers["etag"]}).status_code == 304
        tracemalloc.start()
        try:
            with http.stream("GET", url) as answer:
                size = sum(map(len, answer.iter_raw()))
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert size == len(whole.content)
    assert peak < size / 2


@pytest.mark.parametrize(
    ("asked", "few"),
    [
        ("7:19", slice(7, 19)),
        ("::13", slice(None, None, 13)),
        ("50:999:4", slice(50, None, 4)),
        (":", slice(None)),
    ],
)
def test_some_frames_are_those_of_all(
    live: Live, fitted: dict[str, Any], asked: str, few: slice
) -> None:
    url = f"/fits/{fitted['id']}/reconstruction"
    some, whole = (
        load(live.http.get(f"{url}?format=safetensors{query}").content)
        for query in (f"&frames={asked}", "")
    )
    assert some.keys() == whole.keys()
    for name, array in some.items():
        np.testing.assert_array_equal(array, whole[name][few])
    nested = live.http.get(f"{url}?frames={asked}").json()
    assert nested["frames"] == live.http.get(url).json()["frames"][few]


def test_some_frames_of_a_long_fit_are_read_in_parts(settings: Settings, api: TestClient) -> None:
    numbers = np.arange(3000 * 200, dtype=np.float32).reshape(3000, 200)
    models = np.zeros((3000, 1), np.int8)
    stored = save({"camera_models": models, "points3d": numbers})
    fit = stored_fit(settings, make_dataset(api), stored, frames=3000)
    for asked, few in (("11:2900:7", slice(11, 2900, 7)), ("2000:2600", slice(2000, 2600))):
        answer = api.get(f"/fits/{fit}/reconstruction?format=safetensors&frames={asked}")
        np.testing.assert_array_equal(load(answer.content)["points3d"], numbers[few])


@pytest.mark.parametrize(
    ("query", "pointer"),
    [
        ("frames=3", "/frames"),
        ("frames=-5:", "/frames"),
        ("frames=::0", "/frames"),
        ("frames=60:90", "/frames"),
        ("frames=5:5", "/frames"),
        ("frames=5:9&refine=off", "/refine"),
    ],
)
def test_frames_that_there_are_not_are_refused(
    live: Live, fitted: dict[str, Any], query: str, pointer: str
) -> None:
    answer = live.http.get(f"/fits/{fitted['id']}/reconstruction?{query}")
    problem(answer, 422, "invalid_input", pointer)


@pytest.mark.parametrize("harm", HARMS)
def test_a_damaged_reconstruction_is_not_served(
    api: TestClient, settings: Settings, harm: Callable[[Path], None]
) -> None:
    arrays = {name: np.ones((9, 2), np.float32) for name in ("scales", "camera_models")}
    fit = stored_fit(settings, make_dataset(api), save(arrays))
    (file,) = (settings.data_dir / "objects" / "fits" / fit).iterdir()
    harm(file)
    for query in ("", "?format=npz"):
        message = problem(api.get(f"/fits/{fit}/reconstruction{query}"), 500, "object_damaged")
        assert f"fits/{fit}/reconstruction" in message


def test_a_long_fit_is_refined_otherwise_in_parts(api: TestClient, settings: Settings) -> None:
    fit = stored_fit(settings, make_dataset(api), b"", frames=settings.max_frames + 1)
    response = api.get(f"/fits/{fit}/reconstruction?refine=full")
    detail = problem(response, 422, "invalid_input", "/refine")
    assert "in parts with POST /lift" in detail
    response = api.get(f"/fits/{fit}/reconstruction?uncertainty=full")
    problem(response, 422, "invalid_input", "/uncertainty")
    fit = stored_fit(settings, make_dataset(api, seed=1), b"", frames=settings.max_frames)
    with served(settings.model_copy(update={"max_body_bytes": 2**19})) as http:
        response = http.get(f"/fits/{fit}/reconstruction?uncertainty=full")
        detail = problem(response, 422, "invalid_input", "/uncertainty")
    assert "POST /lifts" in detail


@pytest.mark.parametrize("what", ["reconstruction", "weights"])
def test_downloads_can_be_resumed(live: Live, fitted: dict[str, Any], what: str) -> None:
    if what == "weights":
        url = f"/models/{fitted['model_id']}/weights"
    else:
        url = f"/fits/{fitted['id']}/reconstruction?format=safetensors"
    assert_can_be_resumed(live, url)
