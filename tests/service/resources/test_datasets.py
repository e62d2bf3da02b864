"""Datasets: every way in gives the same capture."""

from typing import Any

import numpy as np
import orjson
import pytest
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture
from tests.service.conftest import (
    BYTES,
    JSON,
    frames_of,
    make_dataset,
    nested,
    problem,
    to_npz,
    to_safetensors,
)


@pytest.fixture(scope="session")
def arrays(capture: SyntheticCapture) -> dict[str, np.ndarray[Any, Any]]:
    points3d = capture.points3d.copy()
    points3d[2] = np.nan
    points3d[3, 4] = np.nan
    return {
        "keypoints": capture.keypoints,
        "confidence": capture.confidence,
        "points3d": points3d,
    }


@pytest.fixture(scope="session")
def description(capture: SyntheticCapture) -> dict[str, Any]:
    return {
        "name": "a figure",
        "skeleton": {
            "keypoint_names": list(capture.keypoint_names),
            "edges": [list(edge) for edge in capture.edges],
        },
        "image_sizes": [[1280, 1024], None, [640, 480]],
        "metadata": {"subject": {"code": "M7", "sessions": [1, 2]}},
    }


@pytest.fixture(scope="session")
def reference(
    api: TestClient, arrays: dict[str, np.ndarray[Any, Any]], description: dict[str, Any]
) -> dict[str, Any]:
    """Send the capture as JSON, null wherever something was not observed."""
    body = {
        **description,
        "keypoints": frames_of(arrays["keypoints"]),
        "confidence": arrays["confidence"].tolist(),
        "points3d": [nested(frame) for frame in arrays["points3d"]],
    }
    response = api.post("/datasets", content=orjson.dumps(body), headers=JSON)
    assert response.status_code == 201, response.text
    made: dict[str, Any] = response.json()
    assert response.headers["Location"] == f"/datasets/{made['id']}"
    return made


def test_a_preview_says_what_would_be_stored(
    api: TestClient, arrays: dict[str, Any], description: dict[str, Any], unchanged: None
) -> None:
    keypoints = arrays["keypoints"].copy()
    keypoints[:, 1, :3] = np.nan
    keypoints[7] = np.arange(3 * 16 * 2).reshape(3, 16, 2)  # all of it is seen
    keypoints[3, 1, 2] = np.nan
    body = {**description, "keypoints": frames_of(keypoints)}
    shown = api.post("/previews", content=orjson.dumps(body), headers=JSON)
    assert shown.status_code == 200
    preview = shown.json()
    assert (preview["frame"], preview["frame_keypoints"]) == (7, keypoints[7].tolist())
    assert preview.items() >= description.items()
    assert "id" not in preview
    assert preview["findings"], "a keypoint that is seen nowhere but once"
    empty = to_npz(keypoints=np.full((2, 2, 4, 2), np.nan))
    nothing = api.post("/previews", content=empty, headers=BYTES).json()
    assert nothing["frame_keypoints"] == [[None] * 4] * 2
    unseen = np.ones(keypoints.shape[:3])
    unseen[7] = 0
    doubted = body | {"confidence": unseen.tolist()}
    other = api.post("/previews", content=orjson.dumps(doubted), headers=JSON).json()
    assert other["frame"] != 7, "its keypoints have no confidence"
    wrong = body | {"fps": -1}
    refused = api.post("/previews", content=orjson.dumps(wrong), headers=JSON)
    problem(refused, 422, "invalid_input", "/fps")


def test_what_a_preview_says_is_stored(
    api: TestClient, arrays: dict[str, Any], description: dict[str, Any]
) -> None:
    body = orjson.dumps({**description, "keypoints": frames_of(arrays["keypoints"])})
    shown = api.post("/previews", content=body, headers=JSON).json()
    made = api.post("/datasets", content=body, headers=JSON).json()
    once_stored = ("id", "created_at", "corrections")
    stored = {name: value for name, value in made.items() if name not in once_stored}
    assert shown.items() >= stored.items()


def test_a_dataset_is_described(
    api: TestClient,
    reference: dict[str, Any],
    capture: SyntheticCapture,
    description: dict[str, Any],
) -> None:
    found = api.get(f"/datasets/{reference['id']}")
    assert found.status_code == 200
    assert found.json() == reference
    assert reference.items() >= description.items()
    assert [reference[name] for name in ("frames", "views", "keypoints")] == [60, 3, 16]
    assert reference["has_confidence"] is reference["has_ground_truth"] is True
    missing = np.isnan(capture.keypoints[..., 0]).mean((0, 2))
    assert 0 < missing.min() < missing.max()
    np.testing.assert_allclose(reference["missing_fraction"], missing, atol=1e-6)


@pytest.mark.parametrize("encode", [to_npz, to_safetensors])
def test_files_are_the_same_capture(
    api: TestClient,
    reference: dict[str, Any],
    arrays: dict[str, np.ndarray[Any, Any]],
    encode: Any,
) -> None:
    response = api.post("/datasets?name=bytes", content=encode(**arrays), headers=BYTES)
    assert response.status_code == 201, response.text
    assert response.json()["name"] == "bytes"
    for field in ("checksum", "frames", "views", "keypoints", "missing_fraction"):
        assert response.json()[field] == reference[field]


def test_a_form_is_the_same_capture(
    api: TestClient,
    reference: dict[str, Any],
    arrays: dict[str, np.ndarray[Any, Any]],
    description: dict[str, Any],
) -> None:
    fields = {
        name: value if isinstance(value, str) else orjson.dumps(value).decode()
        for name, value in description.items()
    }
    response = api.post("/datasets", data=fields, files={"file": ("c.npz", to_npz(**arrays))})
    assert response.status_code == 201, response.text
    apart = {"id": None, "created_at": None}
    assert response.json() | apart == reference | apart


def test_npz_holds_the_description_too(api: TestClient, capture: SyntheticCapture) -> None:
    data = to_npz(
        keypoints=capture.keypoints.astype(">f8"),
        keypoint_names=np.array(capture.keypoint_names),
        edges=np.array(capture.edges),
        image_sizes=np.array(capture.image_sizes),
    )
    found = api.post("/datasets", content=data, headers={"Content-Type": "application/x-npz"})
    assert found.status_code == 201, found.text
    assert found.json()["skeleton"]["keypoint_names"] == list(capture.keypoint_names)
    assert found.json()["skeleton"]["edges"] == [list(edge) for edge in capture.edges]
    assert found.json()["image_sizes"] == [[1280, 1024]] * 3


@pytest.mark.parametrize("cuts", [[1], [7, 8, 40]])
def test_a_streamed_capture_has_the_same_checksum(
    api: TestClient,
    reference: dict[str, Any],
    arrays: dict[str, np.ndarray[Any, Any]],
    cuts: list[int],
) -> None:
    parts = [
        {name: array[start:end] for name, array in arrays.items()}
        for start, end in zip([0, *cuts], [*cuts, 60], strict=True)
    ]
    url = "/datasets"
    for number, part in enumerate(parts):
        if number % 2:
            body = {
                "keypoints": frames_of(part["keypoints"]),
                "confidence": part["confidence"].tolist(),
                "points3d": [nested(frame) for frame in part["points3d"]],
            }
            response = api.post(url, content=orjson.dumps(body), headers=JSON)
        else:
            response = api.post(url, content=to_safetensors(**part), headers=BYTES)
        assert response.status_code == (200 if number else 201), response.text
        url = f"/datasets/{response.json()['id']}/frames"
    for field in ("checksum", "frames", "missing_fraction", "has_ground_truth"):
        assert response.json()[field] == reference[field]


def test_frames_must_suit_the_dataset(api: TestClient) -> None:
    made = make_dataset(api)
    url = f"/datasets/{made['id']}/frames"
    other = np.zeros((1, 3, 16, 2), np.float32)
    detail = problem(
        api.post(url, content=to_npz(keypoints=other), headers=BYTES),
        422,
        "invalid_input",
        "/keypoints",
    )
    assert "2 views of 16 keypoints" in detail
    full = np.zeros((400, 2, 16, 2), np.float32)
    assert api.post(url, content=to_npz(keypoints=full), headers=BYTES).status_code == 200
    detail = problem(
        api.post(url, content=to_npz(keypoints=full), headers=BYTES), 422, "invalid_input"
    )
    assert "at most 500 frames" in detail
    assert api.get(f"/datasets/{made['id']}").json()["frames"] == 406


def test_pages_lose_and_double_nothing(api: TestClient) -> None:
    made = [make_dataset(api, frames=1, seed=n)["id"] for n in range(7)]
    seen: list[str] = []
    cursor, pages = "", 0
    while cursor is not None:
        page = api.get(f"/datasets?limit=3{cursor and f'&cursor={cursor}'}").json()
        seen += [item["id"] for item in page["items"]]
        cursor, pages = page["next_cursor"], pages + 1
        if pages == 1:  # neither a newer dataset nor the loss of the last one seen disturbs
            made.append(make_dataset(api, frames=1)["id"])
            assert api.delete(f"/datasets/{cursor}").status_code == 204
    assert pages >= 3
    assert len(seen) == len(set(seen))
    assert seen == sorted(seen, reverse=True)
    assert set(made[:7]) <= set(seen)


def test_a_deleted_dataset_is_gone(api: TestClient) -> None:
    url = f"/datasets/{make_dataset(api)['id']}"
    assert api.delete(url).status_code == 204
    frames = to_npz(keypoints=np.zeros((1, 2, 16, 2)))
    problem(api.get(url), 404, "not_found")
    problem(api.delete(url), 404, "not_found")
    problem(api.post(f"{url}/frames", content=frames, headers=BYTES), 404, "not_found")
    fit = {"dataset_id": url.removeprefix("/datasets/")}
    problem(api.post("/fits", json=fit), 404, "not_found")


def test_a_dataset_in_use_stays(api: TestClient) -> None:
    made = make_dataset(api)
    fit = api.post("/fits", json={"dataset_id": made["id"]}).json()
    assert fit["id"] in problem(api.delete(f"/datasets/{made['id']}"), 409, "conflict")
    assert api.post(f"/fits/{fit['id']}/cancel").json()["status"] == "cancelled"
    assert api.delete(f"/datasets/{made['id']}").status_code == 204


def test_arrays_that_a_capture_has_besides_are_ignored(api: TestClient) -> None:
    keypoints = np.ones((2, 1, 4, 2), np.float32)
    body = to_npz(keypoints=keypoints, clip=np.arange(2), unit=np.array("mm"))
    response = api.post("/datasets", content=body, headers=BYTES)
    assert response.status_code == 201, response.text
    assert response.json()["frames"] == 2
    assert response.json()["has_confidence"] is False


def test_times_are_kept_whichever_way_they_come(
    api: TestClient, arrays: dict[str, np.ndarray[Any, Any]]
) -> None:
    times = 1.7e9 + np.arange(60) / 50
    body = {"keypoints": frames_of(arrays["keypoints"]), "times": times.tolist(), "fps": 50}
    posted = api.post("/datasets", content=orjson.dumps(body), headers=JSON)
    assert posted.status_code == 201, posted.text
    assert (posted.json()["fps"], posted.json()["has_times"]) == (50, True)
    for encode in (to_npz, to_safetensors):
        data = encode(keypoints=arrays["keypoints"], times=times, fps=np.array(50.0))
        sent = api.post("/datasets", content=data, headers=BYTES)
        assert sent.status_code == 201, sent.text
        for field in ("checksum", "fps", "has_times"):
            assert sent.json()[field] == posted.json()[field]
    later = to_npz(keypoints=arrays["keypoints"], times=times + 2)
    path = f"/datasets/{posted.json()['id']}/frames"
    assert api.post(path, content=later, headers=BYTES).json()["frames"] == 120
    problem(api.post(path, content=later, headers=BYTES), 422, "invalid_input", "/times")


@pytest.mark.parametrize(
    ("fields", "pointer"),
    [
        ({"fps": 0}, "/fps"),
        ({"fps": 1e-300}, "/fps"),
        ({"fps": 2e5}, "/fps"),
        ({"times": [0.0] * 60}, "/times"),
        ({"times": [0.0, None]}, "/times/1"),
        ({"times": [[0.0, 1.0]]}, "/times/0"),
        ({"times": 3}, "/times/0"),
        ({"fps": 25, "times": [n / 50 for n in range(60)]}, "/fps"),
    ],
)
def test_times_that_cannot_be_are_refused(
    api: TestClient, arrays: dict[str, np.ndarray[Any, Any]], fields: dict[str, Any], pointer: str
) -> None:
    body = {"keypoints": frames_of(arrays["keypoints"]), **fields}
    answer = api.post("/datasets", content=orjson.dumps(body), headers=JSON)
    problem(answer, 422, "invalid_input", pointer)


def test_confidences_a_little_above_1_are_clipped_with_a_note(api: TestClient) -> None:
    keypoints = np.random.default_rng(1).uniform(0, 900, (6, 2, 5, 2))
    confidence = np.full((6, 2, 5), 0.9)
    confidence[0, 0, 0] = 1.0
    expected = api.post(
        "/datasets", content=to_npz(keypoints=keypoints, confidence=confidence), headers=BYTES
    ).json()
    confidence[0, 0, 0] = 1.0992
    body = {"keypoints": keypoints.tolist(), "confidence": confidence.tolist()}
    for answer in (
        api.post("/datasets", json=body),
        api.post(
            "/datasets", content=to_npz(keypoints=keypoints, confidence=confidence), headers=BYTES
        ),
    ):
        assert answer.status_code == 201, answer.text
        assert answer.json()["notes"] == ["confidences up to 1.099 were clipped to 1"]
    assert expected["notes"] == []
    assert answer.json()["missing_fraction"] == expected["missing_fraction"]


def test_names_of_views_are_kept(api: TestClient) -> None:
    keypoints = np.random.default_rng(1).uniform(0, 900, (6, 2, 5, 2))
    names = ["left", "right"]
    body = to_npz(keypoints=keypoints, view_names=np.array(names))
    sent = api.post("/datasets", content=body, headers=BYTES).json()
    posted = api.post("/datasets", json={"keypoints": keypoints.tolist(), "view_names": names})
    for made in (sent, posted.json()):
        assert api.get(f"/datasets/{made['id']}").json()["view_names"] == names
    wrong = {"keypoints": keypoints.tolist(), "view_names": [*names, "top"]}
    problem(api.post("/datasets", json=wrong), 422, "invalid_input", "/view_names")


@pytest.mark.parametrize(
    ("arrays", "status", "message"),
    [
        ({"keypoints": np.zeros((2, 2, 3, 2))}, 422, "4 to 32 keypoints, got 3"),
        ({"keypoints": np.zeros((2, 2, 5, 3))}, 422, "keypoints[..., 2] as `confidence`"),
        (
            {"keypoints": np.ones((2, 2, 4, 2)), "keypoint_names": np.array(["a", "b", "c", "a"])},
            422,
            "'a' is there 2 times",
        ),
        (
            {"keypoints": np.ones((2, 2, 4, 2)), "keypoint_names": np.array([*"abcd"], object)},
            400,
            "numpy.array(names, str)",
        ),
    ],
)
def test_what_is_refused_says_how_to_mend_it(
    api: TestClient, arrays: dict[str, Any], status: int, message: str
) -> None:
    answer = api.post("/datasets", content=to_npz(**arrays), headers=BYTES)
    assert answer.status_code == status
    assert message in answer.json()["detail"]
