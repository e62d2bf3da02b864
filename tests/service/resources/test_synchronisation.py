"""A capture with a late view on its whole way: upload, fit, reconstruction, lift."""

from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load

from tests.models.walk import film
from tests.service.conftest import BYTES, Live, to_npz

FRAMES = 96
LATE = 4.5  # frames


def upload(live: Live, keypoints: Any, **fields: Any) -> str:
    """Store a capture in two parts, with times or fps or neither."""
    times = fields.pop("times", None)
    dataset = ""
    for part in (slice(0, 50), slice(50, None)):
        arrays = {"keypoints": keypoints[part], **(fields if not dataset else {})}
        if times is not None:
            arrays["times"] = times[part]
        path = f"/datasets/{dataset}/frames" if dataset else "/datasets"
        answer = live.http.post(path, content=to_npz(**arrays), headers=BYTES)
        assert answer.status_code in (200, 201), answer.text
        dataset = answer.json()["id"]
    return dataset


def out_of_step(found: dict[str, Any]) -> list[dict[str, Any]]:
    return [one for one in found["findings"] if one["code"] == "views_out_of_step"]


@pytest.fixture(scope="module")
def late_film() -> Any:
    moments = np.arange(20.0, 20 + FRAMES)[:, None] - np.array([0, LATE, 0])
    return film([0, 70, 160], moments, noise=0.3).astype(np.float32)


def test_fits_and_lifts_of_datasets_are_in_step(live: Live, late_film: Any) -> None:
    dataset = upload(live, late_film, times=5e6 + np.arange(FRAMES) / 30)
    fit = live.finished(live.fit(dataset, synchronise="auto")["id"])
    assert fit["status"] == "succeeded", fit["error"]
    [finding] = out_of_step(fit)
    assert finding["views"] == [1]
    assert finding["evidence"]["offset_frames"] == pytest.approx(LATE, abs=0.1)
    assert finding["evidence"]["offset_seconds"] == pytest.approx(LATE / 30, abs=0.004)
    assert finding["evidence"]["applied"] == 1
    assert len(out_of_step(live.get(f"/models/{fit['model_id']}"))) == 1

    rebuilt = live.http.get(f"/fits/{fit['id']}/reconstruction?format=safetensors&refine=off")
    used = load(rebuilt.content)["keypoints_used"]
    assert used[:, 1].tolist()[-5:] == [0] * 5  # what the view shows of these was not filmed
    body = {"model_id": fit["model_id"], "dataset_id": dataset, "refine": "off"}
    lift = live.http.post("/lifts", json=body).json()
    assert live.ended(f"/lifts/{lift['id']}")["status"] == "succeeded"
    lifted = live.http.get(f"/lifts/{lift['id']}/result?format=safetensors")
    for name in ("points3d", "keypoints_used"):  # in chunks of 16 frames
        np.testing.assert_allclose(
            load(lifted.content)[name], load(rebuilt.content)[name], atol=1e-3
        )


def test_frames_per_second_are_enough(live: Live, late_film: Any) -> None:
    fit = live.finished(live.fit(upload(live, late_film, fps=np.array(30.0)), refine="off")["id"])
    assert out_of_step(fit)[0]["evidence"]["applied"] == 1
