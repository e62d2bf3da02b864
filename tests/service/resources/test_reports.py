"""Reports on fits: the same numbers as JSON and as a page, whose names are of users."""

from contextlib import closing
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load
from starlette.testclient import TestClient

from models.capture.clocks import Clocks
from models.capture.synthetic import SyntheticCapture
from models.findings.finding import Finding
from models.lifting.fitted_prior import FittedPrior
from models.settings.calibration import KnownLength
from service.report.document import percent
from service.settings import Settings
from store.database import Store
from tests.service.conftest import BYTES, Live, make_dataset, problem, to_npz
from tests.service.resources.test_reconstructions import stored_fit
from tests.service.stored_fits import put_fit

BROWSER = "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"
HOSTILE = [f"<script>alert({n})</script>" for n in range(16)]
VOID = {"meta"}


class Page(HTMLParser):
    """The tags of a page, which must be closed in their order, and its text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags, self.attributes, self.text = list[str](), list[tuple[str, str | None]](), ""
        self._open = list[str]()
        self.feed(page)
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def hostile(
    api: TestClient, settings: Settings, weights: bytes, capture: SyntheticCapture
) -> dict[str, Any]:
    """Return a fit whose keypoints, views and own name are markup."""
    names = {"keypoint_names": HOSTILE, "view_names": HOSTILE[:3]}
    edges = [[0, 1], [1, 2], [2, 3]]
    body = to_npz(keypoints=capture.keypoints, edges=edges, **names)
    made = api.post("/datasets", content=body, headers=BYTES)
    assert made.status_code == 201, made.text
    skeleton = {"keypoint_names": HOSTILE, "edges": edges}
    with closing(Store(settings)) as records:
        fit_id = put_fit(
            records,
            made.json()["id"],
            FittedPrior.from_bytes(weights),
            capture.keypoints,
            name=HOSTILE[0],
            skeleton=skeleton,
        )
    fit: dict[str, Any] = api.get(f"/fits/{fit_id}").json()
    return fit


def test_a_worker_stores_a_report_beside_the_reconstruction(
    live: Live, fitted: dict[str, Any], capture: SyntheticCapture
) -> None:
    url = f"/fits/{fitted['id']}/report"
    report = live.get(url)
    count, views, keypoints, _ = capture.keypoints.shape
    assert report["verdict"] == fitted["verdict"]
    assert report["verdict"]["expected"].startswith("Points are expected within")
    assert (report["fit_id"], report["version"]) == (fitted["id"], fitted["version"])
    assert len(report["of_keypoints"]) == keypoints
    assert len(report["of_frames"]) == len(report["quality"]) == len(report["reasons"]) == count
    assert np.shape(report["noise_px"]) == (views, keypoints)
    assert len(report["of_views"][0]["views"]) > 1
    assert [view["index"] for view in report["found_cameras"]["views"]] == list(range(views))
    answers = load(live.http.get(f"/fits/{fitted['id']}/reconstruction?format=safetensors").content)
    expected = float(np.sqrt(np.nanmean(np.square(answers["points3d_sd"], dtype=np.float64))))
    assert report["expected_error"] == pytest.approx(expected, rel=1e-3)
    quality = np.array(report["quality"], np.float32)
    np.testing.assert_allclose(quality, answers["quality"], rtol=1e-3)
    assert report["unit"] is None


def test_the_worst_frames_are_those_of_the_reconstruction(
    live: Live, fitted: dict[str, Any], capture: SyntheticCapture
) -> None:
    report = live.get(f"/fits/{fitted['id']}/report")
    answers = load(live.http.get(f"/fits/{fitted['id']}/reconstruction?format=safetensors").content)
    assert [drawn["frame"] for drawn in report["drawn"]] == report["worst_frames"]
    checked = 0
    for drawn in report["drawn"]:
        n = drawn["frame"]
        for k, view in enumerate(drawn["views"]):
            seen = np.array([point or [np.nan, np.nan] for point in view["detected"]])
            answer = np.array([point or [np.nan, np.nan] for point in view["answered"]])
            shown = capture.confidence[n, k] > 0
            np.testing.assert_allclose(seen[shown], capture.keypoints[n, k][shown], atol=0.06)
            assert np.isnan(seen[~shown]).all()
            used = shown & (answers["outlier_probability"][n, k] < 0.5)
            if answers["camera_models"][n, k] < 0:
                assert np.isnan(answer).all()
            else:
                error = np.linalg.norm(seen - answer, axis=1)[used].mean()
                assert error == pytest.approx(answers["reprojection_errors"][n, k], abs=0.2)
                checked += 1
    assert checked > 10


def test_a_browser_gets_a_page_that_loads_and_runs_nothing(
    live: Live, fitted: dict[str, Any]
) -> None:
    url = f"/fits/{fitted['id']}/report"
    for answer in (
        live.http.get(url, headers={"Accept": BROWSER}),
        live.http.get(f"{url}?format=html"),
    ):
        assert answer.headers["content-type"] == "text/html; charset=utf-8"
        policy = answer.headers["content-security-policy"]
        assert policy.startswith("default-src 'none'; style-src 'sha256-")
        page = Page(answer.text)
        assert fitted["verdict"]["expected"] in page.text
        assert not {"script", "link", "img", "iframe", "object", "a"} & set(page.tags)
        assert not {"src", "href", "style", "srcdoc"} & {name for name, _ in page.attributes}
        assert not any(name.startswith("on") for name, _ in page.attributes)
    assert live.http.get(url).headers["content-type"] == "application/json"
    detail = problem(live.http.get(url, headers={"Accept": "image/png"}), 406, "not_acceptable")
    assert "application/json, text/html" in detail
    problem(live.http.get(f"{url}?format=pdf"), 422, "invalid_input", "/format")


def test_names_of_users_are_text(api: TestClient, hostile: dict[str, Any]) -> None:
    answer = api.get(f"/fits/{hostile['id']}/report", headers={"Accept": BROWSER})
    assert answer.status_code == 200, answer.text
    assert "<script" not in answer.text
    page = Page(answer.text)
    assert all(name in page.text for name in HOSTILE)
    report = api.get(f"/fits/{hostile['id']}/report").json()
    assert report["keypoint_names"] == HOSTILE
    assert report["view_names"] == HOSTILE[:3]
    expected = report["verdict"]["expected"]
    assert "least certain" not in expected or any(name in expected for name in HOSTILE)


def test_timing_and_scale_have_their_deviations(
    api: TestClient, settings: Settings, weights: bytes, capture: SyntheticCapture
) -> None:
    """Of a fit with a known length whose second view was late by four frames."""
    prior = FittedPrior.from_bytes(weights)
    assert prior.posterior is not None
    late = Finding.of(
        "views_out_of_step", views=(1,), offset_frames=4.0, offset_seconds=0.08, sd_frames=0.5
    )
    clocks = Clocks(np.zeros(1), np.array([[0.0, 0.08, 0.0]]))
    config = prior.config.model_copy(
        update={"known_length": KnownLength(keypoints=(0, 1), length=0.3)}
    )
    seen = prior.capture._replace(findings=(late,), clocks=clocks)
    measured = prior.of_capture(config, seen).with_posterior(prior.posterior)
    dataset = make_dataset(api)
    with closing(Store(settings)) as records:
        fit_id = put_fit(records, dataset["id"], measured, capture.keypoints)
    report = api.get(f"/fits/{fit_id}/report").json()
    assert report["views_late"] == [0, 0.08, 0]
    assert report["views_late_sd"] == [None, pytest.approx(0.01), None]
    assert report["unit"] == "known_length"
    assert 0.0001 < report["scale_sd"] < 0.1
    page = Page(api.get(f"/fits/{fit_id}/report?format=html").text)
    assert (
        f"by the same ±\N{NO-BREAK SPACE}{percent(report['scale_sd'])} (standard deviation)"
        in page.text
    )
    assert "0.080.01" in page.text  # cells of one row


def test_a_report_outlives_dataset_and_model(api: TestClient, hostile: dict[str, Any]) -> None:
    url = f"/fits/{hostile['id']}/report"
    before = api.get(url).json()
    assert api.delete(f"/datasets/{hostile['dataset_id']}").status_code == 204
    after = api.get(url).json()
    assert after == before | {"view_names": None}
    assert api.delete(f"/models/{hostile['model_id']}").status_code == 204
    last = api.get(url).json()
    assert last["found_cameras"] is None
    assert last["of_keypoints"] == before["of_keypoints"]
    Page(api.get(f"{url}?format=html").text)


def test_fits_without_a_report_are_named(api: TestClient, settings: Settings) -> None:
    problem(api.get("/fits/fit_01m7yspf3gqz6cz1v8e7ch3y7c/report"), 404, "not_found")
    dataset = make_dataset(api)
    older = stored_fit(settings, dataset, b"")
    detail = problem(api.get(f"/fits/{older}/report"), 409, "conflict")
    assert "an older version fitted it" in detail
    queued = api.post("/fits", json={"dataset_id": dataset["id"]}).json()
    detail = problem(api.get(f"/fits/{queued['id']}/report"), 409, "conflict")
    assert "queued: only a fit that succeeded has one" in detail
    assert api.get(f"/fits/{older}").json()["verdict"]["expected"] is None
