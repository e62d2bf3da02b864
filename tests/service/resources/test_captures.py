"""Captures come out of a dataset as they went in."""

import io
from typing import Any

import numpy as np
import orjson
import pytest
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture, synthetic_capture
from tests.service.conftest import BYTES, make_dataset, problem, to_npz

LINKS = {"id", "created_at", "name", "metadata"}


def download(api: TestClient, dataset: str) -> Any:
    response = api.get(f"/datasets/{dataset}/capture")
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == "application/octet-stream"
    return response


def arrays_in(data: bytes) -> dict[str, np.ndarray[Any, Any]]:
    with np.load(io.BytesIO(data)) as file:
        return dict(file)


@pytest.mark.parametrize("clock", [None, "fps", "frames", "views"])
def test_a_capture_comes_out_as_it_went_in(
    api: TestClient, capture: SyntheticCapture, clock: str | None
) -> None:
    truth = capture.points3d.astype(np.float32)
    truth[3, 4] = np.nan
    seconds = 1e9 + np.cumsum(np.random.default_rng(0).uniform(0.01, 0.02, 60))
    given: dict[str | None, Any] = {
        None: {},
        "fps": {"fps": np.float64(59.94)},
        "frames": {"times": seconds},
        "views": {"times": seconds[:, None] + [0, 0.001, 0.002]},
    }
    arrays = {
        "keypoints": capture.keypoints.astype(np.float32),
        "confidence": capture.confidence.astype(np.float32),
        "points3d": truth,
        "keypoint_names": np.array([f"Gelenk ü{p}" for p in range(16)]),
        "edges": np.array([[0, 1], [1, 2]]),
        "view_names": np.array(["left", "right", "Süd"]),
        "image_sizes": np.array([[1280, 1024], [0, 0], [640, 480]]),
        **given[clock],
    }
    sent = api.post("/datasets?name=figure", content=to_npz(**arrays), headers=BYTES).json()
    assert sent["image_sizes"] == [[1280, 1024], None, [640, 480]]
    file = download(api, sent["id"])
    found = arrays_in(file.content)
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        assert found[name].shape == array.shape
        assert found[name].tobytes() == array.tobytes(), name  # NaN too
    again = api.post("/datasets", content=file.content, headers=BYTES).json()
    assert {field for field in sent if sent[field] != again[field]} <= LINKS
    assert download(api, again["id"]).content == file.content


def test_a_capture_that_came_in_parts_comes_out_whole(api: TestClient) -> None:
    """Frames without confidence count fully, frames without a truth have none."""
    seen = synthetic_capture(frames=50, views=2, hidden_keypoints=0.1, seed=3)
    dataset = make_dataset(api, frames=6)
    first = arrays_in(download(api, dataset["id"]).content)
    assert first.keys() == {"keypoints"}
    for start in (0, 20):
        part = slice(start, start + 20)
        more = {"confidence": seen.confidence[part]} if start else {}
        truth = {} if start else {"points3d": seen.points3d[part]}
        body = to_npz(keypoints=seen.keypoints[part].astype(np.float32), **more, **truth)
        url = f"/datasets/{dataset['id']}/frames"
        assert api.post(url, content=body, headers=BYTES).status_code == 200
    whole = download(api, dataset["id"])
    found = arrays_in(whole.content)
    assert found["keypoints"].shape == (46, 2, 16, 2)
    np.testing.assert_array_equal(found["keypoints"][:6], first["keypoints"])
    np.testing.assert_array_equal(found["keypoints"][6:], seen.keypoints[:40].astype(np.float32))
    assert (found["confidence"][:26] == 1).all()
    np.testing.assert_array_equal(
        found["confidence"][26:], seen.confidence[20:40].astype(np.float32)
    )
    np.testing.assert_array_equal(found["points3d"][6:26], seen.points3d[:20].astype(np.float32))
    assert np.isnan(found["points3d"][:6]).all()
    assert np.isnan(found["points3d"][26:]).all()

    url, tag = f"/datasets/{dataset['id']}/capture", whole.headers["etag"]
    assert int(api.head(url).headers["content-length"]) == len(whole.content)
    for start, end in ((0, 10), (900, 20_000), (len(whole.content) - 3000, len(whole.content))):
        headers = {"Range": f"bytes={start}-{end - 1}", "If-Range": tag}
        ranged = api.get(url, headers=headers)
        assert ranged.status_code == 206
        assert ranged.content == whole.content[start:end]
    assert api.get(url, headers={"If-None-Match": tag}).status_code == 304
    body = to_npz(keypoints=seen.keypoints[:1])
    api.post(f"/datasets/{dataset['id']}/frames", content=body, headers=BYTES)
    changed = api.get(url, headers={"Range": "bytes=0-9", "If-Range": tag})
    assert changed.status_code == 200
    assert changed.headers["etag"] != tag

    problem(api.get("/datasets/ds_none/capture"), 404, "not_found")
    problem(api.get(f"{url}?format=json"), 422, "invalid_input")
    api.delete(f"/datasets/{dataset['id']}")
    problem(api.get(url), 404, "not_found")


def test_sizes_of_images_that_are_no_list_are_refused(api: TestClient) -> None:
    seen = synthetic_capture(frames=4, views=2)
    for sizes in (np.array(7), np.array([7, 8]), np.array([[0, 5], [1, 2]])):
        body = to_npz(keypoints=seen.keypoints, image_sizes=sizes)
        problem(api.post("/datasets", content=body, headers=BYTES), 422, "invalid_input")
    skeleton = orjson.dumps({"edges": []}).decode()
    form = {"skeleton": skeleton}
    files = {"file": ("a.npz", to_npz(keypoints=seen.keypoints))}
    made = api.post("/datasets", data=form, files=files).json()
    assert arrays_in(download(api, made["id"]).content).keys() == {"keypoints"}
