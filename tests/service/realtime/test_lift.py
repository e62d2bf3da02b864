"""Lifting: the same numbers in every format, right to the last pixel."""

from typing import Any

import numpy as np
import orjson
import pytest
from pydantic import TypeAdapter
from safetensors.numpy import load
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture
from models.lifting.fitted_prior import FittedPrior
from models.lifting.frames_json import frames_to_json
from models.lifting.lift import CAMERA_MODELS, LiftedFrames
from models.posterior.quality import REASONS
from models.settings.keypoints import OUTLIER
from service.wire.schemas import LiftedFrame
from tests.service.conftest import BYTES, JSON, frames_of, problem, to_npz, to_safetensors

Array = np.ndarray[Any, Any]


def lift(
    api: TestClient, model: str, frames: Any, confidence: Any = None, **more: Any
) -> list[Any]:
    body = {"model": model, "frames": frames, "confidence": confidence, **more}
    response = api.post("/lift", content=orjson.dumps(body), headers=JSON)
    assert response.status_code == 200, response.text
    assert response.json()["model"] == model
    answer: list[Any] = response.json()["frames"]
    return answer


def check_json(frames: list[Any], arrays: dict[str, Array]) -> None:
    assert len(frames) == len(arrays["points3d"])
    for n, frame in enumerate(frames):
        if frame["status"] == "ok":
            np.testing.assert_allclose(frame["points3d"], arrays["points3d"][n], rtol=1e-6)
        else:
            assert np.isnan(arrays["points3d"][n]).all()
        off = frame["points3d_sd"]
        off = [None] * arrays["points3d_sd"].shape[1] if off is None else off
        np.testing.assert_allclose(np.array(off, np.float32), arrays["points3d_sd"][n], rtol=1e-6)
        if frame["quality"] is None:
            assert np.isnan(arrays["quality"][n])
        else:
            assert np.float32(frame["quality"]) == arrays["quality"][n]
        place = arrays["quality_reason"][n]
        assert frame["quality_reason"] == (REASONS[place - 1] if place else None)
        outlying = arrays["outlier_probability"][n]
        if frame["outlier_probability"] is None:
            assert np.isnan(outlying).all()
        else:
            message = np.array(frame["outlier_probability"], np.float32)  # None is NaN
            np.testing.assert_array_equal(message, outlying)
        for k, view in enumerate(frame["views"]):
            for name, value in (
                ("rotation", arrays["rotations"][n, k]),
                ("scale", arrays["scales"][n, k]),
                ("translation", arrays["translations"][n, k]),
                ("focal", arrays["focals"][n, k]),
                ("principal_point", arrays["principal_points"][n, k]),
                ("distortion", arrays["distortions"][n, k]),
                ("reprojection_error", arrays["reprojection_errors"][n, k]),
            ):
                known = value[np.isfinite(value)] if name == "translation" else value
                if view is None or view[name] is None:
                    assert np.isnan(value).all()
                else:
                    np.testing.assert_allclose(view[name], known, rtol=1e-6)
            model = arrays["camera_models"][n, k]
            assert (view and view["camera"]) == (CAMERA_MODELS[model] if model >= 0 else None)
            assert view is None or (view["focal"] is None) == (model == 0)


@pytest.fixture(scope="session")
def expected(weights: bytes, capture: SyntheticCapture) -> dict[str, Array]:
    """Return what the library itself answers."""
    found = FittedPrior.from_bytes(weights).lift(capture.keypoints, confidence=capture.confidence)
    return found.arrays


@pytest.mark.parametrize("sent", ["json", "npz", "safetensors", "form"])
@pytest.mark.parametrize("asked", ["json", "npz", "safetensors"])
def test_every_format_gives_the_numbers_of_the_library(
    api: TestClient,
    model: str,
    capture: SyntheticCapture,
    expected: dict[str, Array],
    tmp_path: Any,
    sent: str,
    asked: str,
) -> None:
    url = f"/lift?model={model}&format={asked}"
    arrays = {"frames": capture.keypoints, "confidence": capture.confidence}
    if sent == "json":
        body = {
            "model": model,
            "frames": frames_of(capture.keypoints),
            "confidence": capture.confidence.tolist(),
        }
        response = api.post(url, content=orjson.dumps(body), headers=JSON)
    elif sent == "form":
        response = api.post(url, files={"file": ("f.npz", to_npz(**arrays))})
    else:
        encode = to_npz if sent == "npz" else to_safetensors
        response = api.post(url, content=encode(**arrays), headers=BYTES)
    assert response.status_code == 200, response.text
    if asked == "json":
        check_json(response.json()["frames"], expected)
        return
    if asked == "npz":
        (tmp_path / "lift.npz").write_bytes(response.content)
        with np.load(tmp_path / "lift.npz") as file:
            found = {name: file[name] for name in file.files}
    else:
        found = load(response.content)
    assert found.keys() == expected.keys()
    for name, array in found.items():
        np.testing.assert_allclose(array, expected[name], rtol=1e-6)


def without_outliers(frame: dict[str, Any], pixels: Array) -> Array:
    """Return the pixels (K, P, 2) that a lifted frame used, NaN where it used none."""
    outlying = np.array(frame["outlier_probability"], np.float64) > OUTLIER
    return np.where(outlying[..., None], np.nan, pixels)


def test_the_cameras_reproject_the_structure(
    api: TestClient, model: str, capture: SyntheticCapture
) -> None:
    """W = s (R X)_xy + t, and the mean distance over what was observed and is no outlier."""
    checked = 0
    frames = lift(api, model, frames_of(capture.keypoints), refine="off")
    for frame, pixels in zip(frames, capture.keypoints.astype(np.float64), strict=True):
        structure = np.array(frame["points3d"])
        np.testing.assert_allclose(structure.mean(0), 0, atol=1e-4)
        for camera, seen in zip(frame["views"], without_outliers(frame, pixels), strict=True):
            if camera is None:
                continue
            rotation = np.array(camera["rotation"])
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
            assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-4)
            assert camera["scale"] > 0
            assert camera["camera"] == "weak_perspective"
            assert camera["focal"] is camera["principal_point"] is camera["distortion"] is None
            image = camera["scale"] * (structure @ rotation.T)[:, :2] + camera["translation"]
            error = np.nanmean(np.linalg.norm(image - seen, axis=-1))
            assert error == pytest.approx(camera["reprojection_error"], rel=1e-3, abs=0.02)
            checked += 1
    assert checked == 60 * 3 - 1


def test_a_frame_is_lifted_on_its_own(
    api: TestClient, model: str, capture: SyntheticCapture
) -> None:
    frames = frames_of(capture.keypoints[:9])
    together = lift(api, model, frames)
    backwards = lift(api, model, frames[::-1])
    for n, frame in enumerate(frames):
        for other in (lift(api, model, [frame])[0], backwards[8 - n]):
            np.testing.assert_allclose(
                other["points3d"], together[n]["points3d"], rtol=1e-4, atol=1e-5
            )
            for a, b in zip(other["views"], together[n]["views"], strict=True):
                assert (a is None) == (b is None)
                if a is not None:
                    np.testing.assert_allclose(
                        a["translation"], b["translation"], rtol=1e-4, atol=1e-5
                    )


def test_frames_that_show_too_little_are_marked(
    api: TestClient, model: str, capture: SyntheticCapture
) -> None:
    good = frames_of(capture.keypoints[:1])[0]
    few: list[Any] = [None] * 16
    few[:3] = [[10.0, 20.0], [30.0, 5.0], [7.0, 50.0]]
    same_place = [[5.0, 5.0]] * 16
    half = [[None, 4.0]] * 16
    for bad in (None, few, same_place, half, [None] * 16):
        answers = lift(api, model, [good, [bad] * 3, [good[0], bad, None]])
        assert [answer["status"] for answer in answers] == ["ok", "too_few_keypoints", "ok"]
        assert answers[0]["reason"] is None
        assert "4 keypoints" in answers[1]["reason"]
        assert answers[1]["points3d"] is None
        assert answers[1]["views"] == [None] * 3
        assert answers[2]["views"][0] is not None
        assert answers[2]["views"][1:] == [None, None]
    only_nulls = lift(api, model, [[None, None]])
    assert only_nulls[0]["status"] == "too_few_keypoints"


@pytest.mark.parametrize("views", [[0], [2, 0], [1, 1, 1, 1]])
def test_any_number_of_views(
    api: TestClient, model: str, capture: SyntheticCapture, views: list[int]
) -> None:
    frames = lift(api, model, frames_of(capture.keypoints[:3, views]))
    assert [frame["status"] for frame in frames] == ["ok"] * 3
    assert all(len(frame["views"]) == len(views) for frame in frames)


def test_confidence_counts(api: TestClient, model: str, capture: SyntheticCapture) -> None:
    keypoints = capture.keypoints[:1].copy()
    confidence = np.isfinite(keypoints[..., 0]).astype(float)
    plain = lift(api, model, frames_of(keypoints))
    assert lift(api, model, frames_of(keypoints), confidence.tolist()) == plain

    hidden = keypoints.copy()
    hidden[0, 0, 5] = np.nan
    confidence[0, 0, 5] = 0
    keypoints[0, 0, 5] = 9999
    nulls: list[Any] = confidence.tolist()
    nulls[0][0][5] = None
    expected = lift(api, model, frames_of(hidden))
    assert lift(api, model, frames_of(keypoints), confidence.tolist()) == expected
    assert lift(api, model, frames_of(keypoints), nulls) == expected
    assert expected != plain
    weighted = lift(api, model, frames_of(capture.keypoints[:1]), (0.3 * confidence).tolist())
    check = lift(api, model, frames_of(capture.keypoints[:1]), (confidence**2).tolist())
    assert weighted[0]["status"] == check[0]["status"] == "ok"


def test_other_keypoints_than_the_models_are_named(
    api: TestClient, model: str, capture: SyntheticCapture
) -> None:
    frames = frames_of(capture.keypoints[:2, :, :12])
    body = orjson.dumps({"model": model, "frames": frames})
    detail = problem(api.post("/lift", content=body, headers=JSON), 422, "invalid_input", "/frames")
    assert "expected 16 keypoints as in the model, got 12" in detail


def test_files_need_the_model_in_the_query(api: TestClient, capture: SyntheticCapture) -> None:
    data = to_npz(frames=capture.keypoints)
    problem(api.post("/lift", content=data, headers=BYTES), 422, "invalid_input", "/model")
    problem(api.post("/lift?model=mdl_no", content=data, headers=BYTES), 404, "not_found")
    problem(
        api.post("/lift?model=mdl_no", content=to_npz(confidence=np.ones(3)), headers=BYTES),
        422,
        "invalid_input",
        "/frames",
    )


def test_the_cameras_of_perspective_reproject_the_structure(
    api: TestClient, model: str, capture: SyntheticCapture
) -> None:
    """W = f d(x, y) / z + c with x = R X + t and OpenCV's distortion d."""
    checked = 0
    frames = lift(api, model, frames_of(capture.keypoints), refine="full")
    for frame, pixels in zip(frames, capture.keypoints.astype(np.float64), strict=True):
        structure = np.array(frame["points3d"])
        for camera, seen in zip(frame["views"], without_outliers(frame, pixels), strict=True):
            if camera is None or camera["camera"] != "perspective":
                continue
            rotation = np.array(camera["rotation"])
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
            camera_frame = structure @ rotation.T + camera["translation"]
            assert (camera_frame[:, 2] > 0).all()
            flat = camera_frame[:, :2] / camera_frame[:, 2:]
            k1, k2, p1, p2, k3, *more = camera["distortion"]
            assert (p1, p2, *more) == (0,) * 5
            squared = np.square(flat).sum(-1, keepdims=True)
            bent = flat * (1 + k1 * squared + k2 * squared**2 + k3 * squared**3)
            image = camera["focal"] * bent + camera["principal_point"]
            error = np.nanmean(np.linalg.norm(image - seen, axis=-1))
            assert error == pytest.approx(camera["reprojection_error"], rel=1e-3, abs=0.02)
            scale = np.mean(camera["focal"]) / camera["translation"][2]
            assert camera["scale"] == pytest.approx(scale, rel=1e-4)
            checked += 1
    assert checked > 0.9 * 60 * 3


def test_every_kind_of_camera_on_the_wire() -> None:
    """A view of each camera model, and one that has no camera."""
    models = np.array([[0, 1, 2, -1]], np.int8)
    rng = np.random.default_rng(0)

    def values(*shape: int, of: Array = models >= 0) -> Array:
        found = rng.uniform(1, 2, (1, 4, *shape)).astype(np.float32)
        found[~of] = np.nan
        return found

    translations = values(3)
    translations[0, 0, 2] = np.nan
    arrays = LiftedFrames(
        points3d=rng.uniform(-1, 1, (1, 5, 3)).astype(np.float32),
        points3d_covariance=np.empty((1, 5, 0), np.float32),
        points3d_modes=np.empty((1, 5, 3, 0), np.float32),
        rotations=values(3, 3),
        scales=values(),
        translations=translations,
        focals=values(2, of=models > 0),
        principal_points=values(2, of=models > 0),
        distortions=values(8, of=models > 0),
        camera_models=models,
        reprojection_errors=values(),
        keypoints_used=np.array([[5, 5, 5, 0]], np.int32),
        points3d_sd=np.array([[0.25, np.nan, 0.001, 1, 0.5]], np.float32),
        keypoints_seen=np.array([[3, 2, 0, 1, 3]], np.uint8),
        outlier_probability=np.array([[[np.nan, 0.25, 0, 1, 0.001]] * 4], np.float32),
        quality=np.array([0.25], np.float32),
        quality_reason=np.array([2], np.uint8),
        findings=np.array([5], np.uint8),
        continued=np.zeros(1, np.bool_),
        sizes=np.ones(1, np.float32),
        misfits=np.ones(1, np.float32),
        rig_residuals=np.ones(1, np.float32),
    ).arrays
    frames = [orjson.loads(text) for text in frames_to_json(arrays)]
    check_json(frames, arrays)
    TypeAdapter(list[LiftedFrame]).validate_python(frames)
    assert len(frames[0]["views"][0]["translation"]) == 2
    assert frames[0]["views"][3] is None


def test_views_and_refine_can_be_given_with_json_and_with_bytes(
    api: TestClient, model: str, capture: SyntheticCapture
) -> None:
    keypoints = capture.keypoints[:4, [2, 0]]
    message = lift(api, model, frames_of(keypoints), refine="off", views=[2, 0])
    url = f"/lift?model={model}"
    more = "refine=off&views=2&views=0"
    body = {"model": model, "frames": frames_of(keypoints)}
    for response in (
        api.post(f"{url}&{more}", content=to_npz(frames=keypoints), headers=BYTES),
        api.post(f"{url}&{more}", content=orjson.dumps(body), headers=JSON),
    ):
        assert response.status_code == 200, response.text
        assert response.json()["frames"] == message


def test_named_views_keep_their_lenses_and_may_come_in_any_order(
    api: TestClient, model: str, capture: SyntheticCapture
) -> None:
    plain = lift(api, model, frames_of(capture.keypoints[:5]), refine="full")
    turned = lift(api, model, frames_of(capture.keypoints[:5, [2, 0]]), refine="full", views=[2, 0])
    checked = 0
    for frame, other in zip(plain, turned, strict=True):
        for view, mine in ((2, other["views"][0]), (0, other["views"][1])):
            camera = frame["views"][view]
            if camera["camera"] == mine["camera"] == "perspective":
                assert camera["focal"] == mine["focal"]
                assert camera["principal_point"] == mine["principal_point"]
                checked += 1
    assert checked > 5
    # For bytes the query gives the same.
    response = api.post(
        "/lift",
        params={"model": model, "views": [2, 0], "refine": "full", "format": "json"},
        content=to_npz(frames=capture.keypoints[:5, [2, 0]]),
        headers=BYTES,
    )
    assert response.json()["frames"] == turned
