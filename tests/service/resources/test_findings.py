"""Findings as users meet them: at upload, as frames are added, in fits, models and lifts."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from safetensors import safe_open
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture
from service.wire.findings import FindingForm
from tests.models.rigs import make_rig_capture
from tests.service.conftest import (
    BYTES,
    CONFIG,
    Live,
    frames_of,
    job_events,
    to_npz,
)

Float32 = NDArray[np.float32]
SIZES = [[1280, 1024]] * 3


def stuck(k: Float32) -> None:
    k[:, 1, 3] = 5


def never_seen(k: Float32) -> None:
    k[:, :, 4] = np.nan


def seen_alone(k: Float32) -> None:
    k[:, 1:, 4] = np.nan


def blind(k: Float32) -> None:
    k[:, 2] = np.nan


def identical(k: Float32) -> None:
    k[:, 2] = k[:, 0]


def shares(k: Float32) -> None:
    k /= 1280


def beyond(k: Float32) -> None:
    k[:, 0, :, 0] += 900


def alone(k: Float32) -> None:
    k[:, 1:] = np.nan


def still(k: Float32) -> None:
    k[:] = k[:1] + np.random.default_rng(0).standard_normal(k.shape)


HARMS: dict[str, tuple[Callable[[Float32], None], dict[str, Any]]] = {
    "keypoint_frozen": (stuck, {"views": [1], "keypoints": [3]}),
    "keypoint_never_seen": (never_seen, {"keypoints": [4]}),
    "view_never_seen": (blind, {"views": [2]}),
    "views_identical": (identical, {"views": [0, 2]}),
    "coordinates_normalised": (shares, {}),
    "outside_image": (beyond, {"views": [0]}),
    "one_view": (alone, {}),
    "no_motion": (still, {}),
}


def uploaded(client: Any, keypoints: Float32) -> dict[str, Any]:
    body = to_npz(keypoints=keypoints, image_sizes=np.array(SIZES))
    response = client.post("/datasets", content=body, headers=BYTES)
    assert response.status_code == 201, response.text
    made: dict[str, Any] = response.json()
    return made


def codes(of: dict[str, Any]) -> list[str]:
    return [FindingForm.model_validate(finding).code for finding in of["findings"]]


@pytest.mark.parametrize("code", HARMS)
def test_harm_is_noticed_at_upload(api: TestClient, capture: SyntheticCapture, code: str) -> None:
    harm, about = HARMS[code]
    keypoints = capture.keypoints.copy()
    harm(keypoints)
    made = uploaded(api, keypoints)
    assert code in codes(made)
    found = next(finding for finding in made["findings"] if finding["code"] == code)
    assert {name: found[name] for name in ("views", "keypoints")} == {
        "views": [],
        "keypoints": [],
    } | about
    assert api.get(f"/datasets/{made['id']}").json()["findings"] == made["findings"]


def test_a_blind_view_does_not_hide_what_is_stuck(
    api: TestClient, capture: SyntheticCapture
) -> None:
    keypoints = capture.keypoints.copy()
    blind(keypoints)
    keypoints[::3, 1, 3] = 5
    assert sorted(codes(uploaded(api, keypoints))) == ["keypoint_frozen", "view_never_seen"]


def test_nothing_is_noticed_of_a_good_capture(api: TestClient, capture: SyntheticCapture) -> None:
    assert uploaded(api, capture.keypoints)["findings"] == []


def test_findings_follow_the_frames_that_are_added(
    api: TestClient, capture: SyntheticCapture
) -> None:
    keypoints = capture.keypoints.copy()
    keypoints[:, 0, 5] = 7  # stuck throughout
    keypoints[:40, :, 9] = np.nan
    made = uploaded(api, keypoints[:20])
    assert codes(made) == ["keypoint_never_seen", "too_few_frames", "keypoint_frozen"]

    def added(frames: slice) -> dict[str, Any]:
        url, body = f"/datasets/{made['id']}/frames", to_npz(keypoints=keypoints[frames])
        response = api.post(url, content=body, headers=BYTES)
        assert response.status_code == 200, response.text
        found: dict[str, Any] = response.json()
        return found

    for frame in range(20, 40):  # so many chunks that not all are looked at
        longer = added(slice(frame, frame + 1))
    assert "keypoint_never_seen" in codes(longer)
    longer = added(slice(40, 60))
    assert codes(longer) == ["keypoint_frozen"]
    assert longer["findings"][0]["keypoints"] == [5]


def test_lifted_frames_say_what_is_odd(
    api: TestClient, model: str, capture: SyntheticCapture
) -> None:
    keypoints = capture.keypoints[:6].copy()
    keypoints[3] /= 1000
    asked = {"model": model, "frames": frames_of(keypoints), "refine": "off"}
    answer = api.post("/lift", json=asked).json()
    assert codes(answer) == ["coordinates_of_another_scale"]
    assert answer["findings"][0]["frames"] == [[3, 3]]
    assert [frame["findings"] for frame in answer["frames"]] == [
        ["coordinates_of_another_scale"] * (n == 3) for n in range(6)
    ]
    seen = np.isfinite(keypoints).all(-1)
    for frame, expected in zip(answer["frames"], seen.sum(1).tolist(), strict=True):
        assert frame["keypoints_seen"] == expected
    arrays = api.post("/lift", json=asked, headers={"Accept": "application/octet-stream"})
    assert b'"findings"' in arrays.content[:4000]


def test_a_fit_and_its_model_have_the_findings(
    live: Live, capture: SyntheticCapture, tmp_path: Any
) -> None:
    keypoints = capture.keypoints.copy()
    seen_alone(keypoints)
    stuck(keypoints)
    dataset = uploaded(live.http, keypoints)
    body = {"dataset_id": dataset["id"], "config": CONFIG | {"steps": 20}}
    fit = live.http.post("/fits", json=body).json()
    assert (fit["findings"], fit["verdict"]) == ([], None)
    *_, (event, _, ended) = job_events(live, f"/fits/{fit['id']}")
    assert (event, ended["status"]) == ("end", "succeeded")
    assert {"keypoint_never_seen", "keypoint_frozen"} <= set(codes(ended))
    deciding = {finding["code"]: finding for finding in ended["findings"]}[ended["verdict"]["code"]]
    assert deciding["severity"] == "warning"
    assert ended["verdict"]["level"] != "good"
    assert ended["verdict"]["remedy"] == deciding["remedy"]
    model = live.get(f"/models/{ended['model_id']}")
    assert model["findings"] == ended["findings"]
    weights = live.http.get(f"/models/{model['id']}/weights").content
    assert (
        live.http.post("/models", content=weights, headers=BYTES).json()["findings"]
        == model["findings"]
    )
    whole = live.get(f"/fits/{fit['id']}/reconstruction")
    assert whole["findings"] == ended["findings"]
    for frame in whole["frames"]:
        assert frame["points3d"][4] is None
        assert frame["keypoints_seen"][4] == 0
        assert None not in [frame["points3d"][p] for p in range(16) if p != 4]
    # A big lift of frames of which some are odd.
    keypoints[20:30] /= 1000
    dataset = uploaded(live.http, keypoints)
    made = live.http.post("/lifts", json={"dataset_id": dataset["id"], "model_id": model["id"]})
    lift = live.ended(f"/lifts/{made.json()['id']}")
    found = {finding["code"]: finding for finding in lift["findings"]}
    assert found["coordinates_of_another_scale"]["frames"] == [[20, 29]]
    file = tmp_path / "result.safetensors"
    url = f"/lifts/{lift['id']}/result?format=safetensors"
    file.write_bytes(live.http.get(url).content)
    with safe_open(file, "np") as result:
        assert "coordinates_of_another_scale" in result.metadata()["findings"]
        assert (result.get_tensor("findings")[20:30] & 4 == 4).all()
        assert result.get_tensor("keypoints_seen").dtype == np.uint8


def test_a_fit_says_in_which_frames_views_changed_places(live: Live) -> None:
    rig = make_rig_capture([0.0, 70.0, 150.0], frames=60, seed=4)
    keypoints = rig.keypoints.astype(np.float32)
    keypoints[40:55] = keypoints[40:55][:, [0, 2, 1]]
    dataset = uploaded(live.http, keypoints)
    body = {"dataset_id": dataset["id"], "config": CONFIG | {"steps": 20, "refine": "off"}}
    fit = live.http.post("/fits", json=body).json()
    *_, (_, _, ended) = job_events(live, f"/fits/{fit['id']}")
    (found,) = [finding for finding in ended["findings"] if finding["code"] == "views_swapped"]
    assert (found["views"], found["frames"]) == ([1, 2], [[40, 54]])
