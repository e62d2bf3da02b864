"""Answers in the room of a model's static cameras: from lifts, streams, reconstructions and jobs.

The model has three static cameras, whose poses are in `/models/{id}/cameras`.
"""

from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import orjson
import pytest
from fewview.calibration import Camera, from_model
from numpy.typing import NDArray
from safetensors.numpy import load, load_file, save

from models.lifting.frames_json import frames_to_json
from service.settings import Settings
from store import attempts, fits
from store.database import Store
from tests.service.conftest import (
    BYTES,
    Live,
    frames_of,
    make_dataset,
    nested,
    problem,
    to_safetensors,
)
from tests.service.realtime.conftest import (
    as_bytes,
    as_json,
    bridged,
    opened,
    read_bytes,
    read_json,
    started,
)
from tests.waiting import wait_for

FIXTURES = Path(__file__).parents[2] / "fixtures"
KEYPOINTS = load_file(FIXTURES / "resting_lifts.safetensors")["keypoints"]
NAMES = [f"left_foot{n}" if n < 2 else f"k{n}" for n in range(16)]
Arrays = dict[str, Any]


def imported(http: httpx2.Client, name: str = "resting") -> str:
    weights = (FIXTURES / f"{name}.safetensors").read_bytes()
    return str(http.post("/models", content=weights, headers=BYTES).json()["id"])


@pytest.fixture(scope="module")
def resting(http: httpx2.Client) -> str:
    return imported(http)


@pytest.fixture(scope="module")
def rig(http: httpx2.Client, resting: str) -> list[Camera]:
    return from_model(http.get(f"/models/{resting}/cameras").json())


def lifted(http: httpx2.Client, model: str, query: str = "", keypoints: Any = KEYPOINTS) -> Arrays:
    url = f"/lift?model={model}&format=safetensors&{query}"
    response = http.post(url, content=to_safetensors(keypoints=keypoints), headers=BYTES)
    assert response.status_code == 200, response.text
    return load(response.content)


def seen_from(arrays: Arrays, n: int, k: int) -> NDArray[np.float64]:
    """Return a frame's points (P, 3) in the axes of one of its views."""
    points, turn = (arrays[name].astype(np.float64) for name in ("points3d", "rotations"))
    return np.asarray(points[n] @ turn[n, k].T + arrays["translations"][n, k])


def test_points_are_where_the_static_cameras_see_them(
    http: httpx2.Client, resting: str, rig: list[Camera]
) -> None:
    """One, two or three views of a frame; the camera of each knows where it stands."""
    canonical, room = lifted(http, resting), lifted(http, resting, "frame=room")
    assert room.keys() == canonical.keys()
    compared = 0
    for n, k in np.argwhere(canonical["camera_models"] > 0):
        camera, there = rig[k], seen_from(canonical, n, k)
        assert camera.rotation is not None
        assert camera.translation is not None
        mine = room["points3d"][n] @ camera.rotation.T + camera.translation
        np.testing.assert_allclose(mine, there, atol=2e-4)
        np.testing.assert_allclose(seen_from(room, n, k), there, atol=1e-5)
        compared += 1
    assert compared == 27
    assert np.ptp(room["points3d"].mean(1), axis=0).max() > 0.1  # it walks
    np.testing.assert_allclose(room["scales"], canonical["scales"], rtol=1e-3)
    assert np.isnan(canonical["points3d_sd"]).all()  # a file without a posterior
    for name in ("focals", "distortions", "reprojection_errors", "camera_models", "keypoints_seen"):
        np.testing.assert_array_equal(room[name], canonical[name])


def test_a_frame_has_its_place_whatever_it_comes_with(http: httpx2.Client, resting: str) -> None:
    all_at_once = lifted(http, resting, "frame=room")
    for n in (0, 1, 2):
        alone = lifted(http, resting, "frame=room", KEYPOINTS[n : n + 1])
        np.testing.assert_allclose(alone["points3d"][0], all_at_once["points3d"][n], atol=1e-5)
    two = lifted(http, resting, "frame=room&views=2&views=0", KEYPOINTS[1:2, [2, 0]])
    np.testing.assert_allclose(two["points3d"][0], all_at_once["points3d"][1], atol=0.02)


def test_streams_and_json_agree(http: httpx2.Client, resting: str) -> None:
    arrays = lifted(http, resting, "frame=room&up=0,-1,0")
    body = {"model": resting, "frames": frames_of(KEYPOINTS), "frame": "room", "up": [0, -1, 0]}
    answer = http.post("/lift", json=body).json()
    with started(http, resting, frame="room", up=[0, -1, 0], continuity=True) as socket:
        for n, keypoints in enumerate(KEYPOINTS):
            socket.send((as_json if n % 2 else as_bytes)(n, keypoints))
        for n, points in enumerate(arrays["points3d"]):
            frame = answer["frames"][n]
            np.testing.assert_array_equal(np.array(frame["points3d"], np.float32), points)
            message = socket.recv(timeout=300)
            mine: Any
            if n % 2:
                mine = read_json(message)["frame"]
                first = mine["views"][0]
            else:
                mine = {"points3d": read_bytes(message).points}
                first = read_bytes(message).views[0]
            # Each continues the frame before.
            np.testing.assert_allclose(mine["points3d"], points, atol=0.02)
            np.testing.assert_allclose(first["rotation"], arrays["rotations"][n, 0], atol=0.01)


def test_up_turns_the_room(http: httpx2.Client, resting: str, rig: list[Camera]) -> None:
    """An imported model has no frames: up is given, and there is no floor."""
    plain = lifted(http, resting, "frame=room")["points3d"]
    raised = lifted(http, resting, "frame=room&up=0,-2,0")
    tiny = lifted(http, resting, "frame=room&up=0,-1e-200,0")
    np.testing.assert_array_equal(tiny["points3d"], raised["points3d"])
    np.testing.assert_allclose(raised["points3d"], plain * np.array([1, -1, -1]), atol=1e-5)
    canonical = lifted(http, resting)
    np.testing.assert_allclose(seen_from(raised, 4, 1), seen_from(canonical, 4, 1), atol=1e-5)
    answer = http.post(f"/lift?frame=room&up=auto&model={resting}", **in_bytes())
    assert "imported" in problem(answer, 409, "conflict")


def in_bytes(keypoints: Any = KEYPOINTS) -> dict[str, Any]:
    return {"content": to_safetensors(keypoints=keypoints), "headers": BYTES}


def test_frames_without_a_place_are_marked(http: httpx2.Client, resting: str) -> None:
    """In weak perspective a structure has no depth; a frame that shows nothing has no structure."""
    keypoints = KEYPOINTS.copy()
    keypoints[3] = np.nan
    arrays = lifted(http, resting, "frame=room&refine=off", keypoints)
    assert np.isnan(arrays["points3d"]).all()
    assert np.isnan(arrays["rotations"]).all()
    assert (arrays["camera_models"] == -1).all()
    assert arrays["findings"].tolist() == [0 if n == 3 else 8 for n in range(10)]
    answer = http.post(f"/lift?frame=room&refine=off&model={resting}", **in_bytes(keypoints)).json()
    statuses = {n: frame["status"] for n, frame in enumerate(answer["frames"])}
    assert statuses == {n: "too_few_keypoints" if n == 3 else "not_in_room" for n in range(10)}
    assert "no static camera" in answer["frames"][0]["reason"]
    assert answer["frames"][0]["points3d"] is None
    assert answer["frames"][0]["views"] == [None] * 3
    assert answer["frames"][0]["findings"] == ["not_in_room"]
    assert [finding["code"] for finding in answer["findings"]] == ["not_in_room"]
    assert answer["findings"][0]["frames"] == [[0, 2], [4, 9]]
    with started(http, resting, frame="room", refine="off") as socket:
        socket.send(as_bytes(0, keypoints[0]))
        _, flags, points, *_ = read_bytes(socket.recv(timeout=300))
        assert flags == 32
        assert np.isnan(points).all()


def test_what_is_asked_of_no_room_is_refused(http: httpx2.Client, resting: str, model: str) -> None:
    def asked(query: str, keypoints: Any = KEYPOINTS) -> httpx2.Response:
        return http.post(f"/lift?{query}", **in_bytes(keypoints))

    for wrong in ("0,0,0", "north", "0,1", "0,nan,1", "1,2,3,4"):
        refused = asked(f"model={resting}&frame=room&up={wrong}")
        problem(refused, 422, "invalid_input", "/up")
    problem(asked(f"model={resting}&up=auto"), 422, "invalid_input", "/up")
    problem(asked(f"model={resting}&frame=world"), 422, "invalid_input", "/frame")
    refused = asked(f"model={resting}&frame=room", KEYPOINTS[:, :2])
    problem(refused, 422, "invalid_input", "/views")
    assert "none of its cameras is static" in problem(
        asked(f"model={model}&frame=room"), 409, "conflict"
    )
    weak = imported(http, "plain")  # fitted without refinement
    assert "unknown" in problem(asked(f"model={weak}&frame=room"), 409, "conflict")
    for first, code in (
        ({"model": model, "frame": "room"}, "conflict"),
        ({"model": resting, "up": "auto"}, "invalid_input"),
    ):
        with opened(http) as socket:
            socket.send(orjson.dumps(first).decode())
            assert orjson.loads(socket.recv(timeout=300))["code"] == code
    with started(http, resting, frame="room") as socket:
        socket.send(as_bytes(3, KEYPOINTS[0, :2]))
        error = orjson.loads(socket.recv(timeout=300))
        assert (error["sequence"], error["errors"][0]["pointer"]) == (3, "/views")


def recorded(http: httpx2.Client, store: Store, reconstruction: Arrays) -> str:
    """Return a fit, as of a worker, that made this reconstruction and the model of these tests."""
    fit = fits.create(store, dataset_id=make_dataset(http)["id"], name="f", config={})
    attempt = attempts.claim(store, fit.id, lease_seconds=60)
    assert attempt is not None
    figures = {"frame_of_reference": "upright"}
    described = {"keypoints": 16, "config": {}, "training_curve": [], "metrics": figures}
    attempts.succeed(
        store,
        attempt,
        weights=(FIXTURES / "resting.safetensors").read_bytes(),
        reconstruction=save(reconstruction),
        progress=None,
        describe=described | {"skeleton": {"keypoint_names": NAMES, "edges": []}},
    )
    return fit.id


def test_the_bridge_has_y_up_and_the_floor_by_default(
    http: httpx2.Client, settings: Settings, resting: str
) -> None:
    store = Store(settings)
    fit = recorded(http, store, lifted(http, resting))
    store.close()
    model = http.get(f"/fits/{fit}").json()["model_id"]
    frames = [{"sequence": n, "keypoints": nested(each)} for n, each in enumerate(KEYPOINTS)]
    expected = lifted(http, model, "frame=room&up=auto")["points3d"]
    found = bridged(http, model, frames)
    assert found.keys() == set(range(len(frames)))
    for n, points in found.items():
        assert np.isfinite(expected[n]).all()
        np.testing.assert_allclose(points, expected[n], atol=0.02)  # each continues the one before
    lowest = [points[:2, 1].min() for points in found.values()]  # of the keypoints named as feet
    assert np.quantile(lowest, 0.1) == pytest.approx(0, abs=0.03)


def test_a_reconstruction_and_its_lifts_share_one_room(
    http: httpx2.Client, settings: Settings, resting: str
) -> None:
    canonical = lifted(http, resting)
    store = Store(settings)
    fit = recorded(http, store, {name: np.concatenate([a] * 100) for name, a in canonical.items()})
    url = f"/fits/{fit}/reconstruction?format=safetensors"
    model = http.get(f"/fits/{fit}").json()["model_id"]
    for query in ("frame=room", "frame=room&up=0,-1,0.2", "frame=room&up=auto"):
        found = load(http.get(f"{url}&{query}").content)
        mine = lifted(http, model, query)
        for name in ("points3d", "rotations", "translations", "scales"):
            everywhere = np.concatenate([mine[name]] * 100)
            np.testing.assert_allclose(found[name], everywhere, atol=1e-5)
        np.testing.assert_allclose(seen_from(found, 5, 2), seen_from(canonical, 5, 2), atol=1e-5)
        if "up" in query:  # a tenth of the lowest feet are below the floor
            lowest = found["points3d"][:, :2, 1].min(1)
            assert np.quantile(lowest, 0.1) == pytest.approx(0, abs=1e-5)
        some = load(http.get(f"{url}&{query}&frames=1:6:2").content)
        np.testing.assert_array_equal(some["points3d"], found["points3d"][1:6:2])
        body = http.get(f"/fits/{fit}/reconstruction?{query}").content  # placed part by part
        assert b'"frames":[' + b",".join(frames_to_json(found)) + b'],"findings":' in body
    problem(http.get(f"{url}&up=auto"), 422, "invalid_input", "/up")
    assert http.get(f"/models/{model}/cameras").json()["frame_of_reference"] == "upright"

    fits.delete(store, fit)  # by another process: its frames gave up and the floor
    store.close()

    def forgotten() -> bool:
        asked = http.post(f"/lift?model={model}&frame=room&up=auto", **in_bytes())
        return asked.status_code == 409

    wait_for(forgotten, "the room of a fit that was deleted", 3)
    assert http.get(f"/models/{model}/cameras").json()["frame_of_reference"] == "room"
    raised = lifted(http, model, "frame=room&up=0,-1,0.2")["points3d"]
    assert abs(np.quantile(raised[:, :2, 1].min(1), 0.1)) > 0.1  # it has no floor


def test_a_big_lift_has_a_room_too(live: Live) -> None:
    """Three chunks of it, as arrays and as JSON lines."""
    model = imported(live.http)
    keypoints = np.tile(KEYPOINTS, (4, 1, 1, 1))
    made = live.http.post("/datasets", **in_bytes(keypoints)).json()
    body = {"model_id": model, "dataset_id": made["id"], "frame": "room", "up": [0, -1, 0]}
    lift = live.http.post("/lifts", json=body).json()
    assert (lift["frame"], lift["up"]) == ("room", [0, -1, 0])
    done = live.ended(f"/lifts/{lift['id']}")
    assert done["status"] == "succeeded", done
    found = load(live.http.get(f"/lifts/{lift['id']}/result?format=safetensors").content)
    expected = lifted(live.http, model, "frame=room&up=0,-1,0", keypoints)
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array)
    lines = live.http.get(f"/lifts/{lift['id']}/result").text.splitlines()
    points = [orjson.loads(line)["points3d"] for line in lines]
    np.testing.assert_array_equal(np.array(points, np.float32), expected["points3d"])
    refused = live.http.post("/lifts", json=body | {"up": "auto"})
    assert "imported" in problem(refused, 409, "conflict")
    del body["frame"]
    problem(live.http.post("/lifts", json=body), 422, "invalid_input", "/up")
