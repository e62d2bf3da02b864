"""The OpenAPI document: valid, committed, with examples, and clients can be made from it."""

import importlib
import io
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from openapi_spec_validator import OpenAPIV31SpecValidator
from pydantic import TypeAdapter
from safetensors.numpy import load
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture
from service.http import errors
from service.openapi import document
from service.realtime import lift
from service.resources import (
    aliases,
    audit,
    cameras,
    corrections,
    datasets,
    evaluations,
    fits,
    health,
    keys,
    labels,
    lifts,
    lists,
    models,
    previews,
    queues,
    reconstructions,
    reports,
    schedules,
    skeletons,
    storage,
    webhooks,
)
from service.wire import watch_messages
from tests.service.conftest import CONFIG, Live, frames_of, to_npz

# Where the forms of answers are.
MODULES = (
    cameras,
    corrections,
    datasets,
    previews,
    evaluations,
    fits,
    reconstructions,
    reports,
    schedules,
    skeletons,
    labels,
    models,
    lift,
    lifts,
    lists,
    watch_messages,
    queues,
    storage,
    keys,
    aliases,
    webhooks,
    audit,
    health,
    errors,
)
COMMITTED = Path(__file__).parents[2] / "docs" / "openapi.json"


@pytest.fixture(scope="module")
def spec() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(document())
    return found


def operations(spec: dict[str, Any]) -> list[dict[str, Any]]:
    return [operation for path in spec["paths"].values() for operation in path.values()]


def wide_csv(keypoints: np.ndarray[Any, Any]) -> bytes:
    """Return one camera's keypoints (N, P, 2) as a plain table."""
    header = ",".join(f"k{k}_{axis}" for k in range(keypoints.shape[1]) for axis in "xy")
    rows = [",".join("" if np.isnan(x) else str(x) for x in frame.ravel()) for frame in keypoints]
    return "\n".join([header, *rows, ""]).encode()


def test_it_is_valid(spec: dict[str, Any]) -> None:
    OpenAPIV31SpecValidator(spec).validate()


def test_it_is_the_committed_one() -> None:
    assert document() == COMMITTED.read_text(), "run `make openapi` and commit docs/openapi.json"


def test_it_is_the_served_one(spec: dict[str, Any], api: TestClient) -> None:
    assert api.get("/openapi.json").json() == spec


def test_its_page_works_offline(api: TestClient) -> None:
    page = api.get("/docs")
    assert page.headers["content-type"].startswith("text/html")
    assert '"openapi.json"' in page.text
    assert "http" not in page.text
    assets = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    types = [api.get(asset).headers["content-type"].partition(";")[0] for asset in assets]
    assert sorted(types) == ["image/png", "text/css", "text/javascript"]
    assert api.get("/docs/assets/nothing.js").status_code == 404


def test_operations_read_like_methods(spec: dict[str, Any]) -> None:
    assert sorted(operation["operationId"] for operation in operations(spec)) == [
        "append_frames",
        "cancel_fit",
        "cancel_lift",
        "change_dataset",
        "change_fit",
        "change_lift",
        "change_model",
        "check_live",
        "check_ready",
        "correct_keypoints",
        "create_dataset",
        "create_fit",
        "create_key",
        "create_lift",
        "create_webhook",
        "delete_dataset",
        "delete_datasets",
        "delete_fit",
        "delete_fits",
        "delete_lift",
        "delete_lifts",
        "delete_model",
        "delete_models",
        "delete_webhook",
        "download_animation",
        "download_capture",
        "download_labels",
        "download_network",
        "download_weights",
        "evaluate",
        "get_dataset",
        "get_fit",
        "get_fit_cameras",
        "get_fit_schedule",
        "get_key",
        "get_labels",
        "get_lift",
        "get_lift_result",
        "get_metrics",
        "get_model",
        "get_model_cameras",
        "get_page_key",
        "get_reconstruction",
        "get_report",
        "get_storage",
        "get_version",
        "get_webhook",
        "import_model",
        "lift",
        "list_aliases",
        "list_audit",
        "list_corrections",
        "list_datasets",
        "list_fits",
        "list_keys",
        "list_lift_streams",
        "list_lifts",
        "list_models",
        "list_queues",
        "list_skeletons",
        "list_webhook_deliveries",
        "list_webhooks",
        "preview_calibration",
        "preview_dataset",
        "revoke_key",
        "set_alias",
        "stream_fit_events",
        "stream_lift_events",
        "stream_lifts",
        "watch_lift_stream",
    ]
    for operation in operations(spec):
        assert operation["summary"]
        assert operation["description"]
        assert len(operation["tags"]) == 1


def test_every_error_is_a_problem(spec: dict[str, Any]) -> None:
    for operation in operations(spec):
        for status, response in operation["responses"].items():
            if status >= "400":
                assert list(response["content"]) == [errors.PROBLEM_JSON], operation["operationId"]
                schema = response["content"][errors.PROBLEM_JSON]["schema"]
                assert schema == {"$ref": "#/components/schemas/Problem"}
        assert {"421", "422", "431", "500", "503"} <= operation["responses"].keys()


def test_what_comes_in_parts_is_documented(spec: dict[str, Any]) -> None:
    answers = [operation["responses"] for operation in operations(spec)]
    in_parts = [found for found in answers if "416" in found]
    assert in_parts
    for found in in_parts:
        assert {"206", "304"} <= found.keys()


def test_every_list_of_words_has_one_name() -> None:
    spec = json.loads(document())
    named = {
        name: tuple(schema.pop("enum"))
        for name, schema in spec["components"]["schemas"].items()
        if "enum" in schema
    }
    assert {"Refine", "JobStatus", "Format", "ResultFormat", "LiftCode"} < named.keys()
    assert len(set(named.values())) == len(named)
    assert '"enum"' not in json.dumps(spec)


def test_answers_have_the_media_types_that_are_sent(spec: dict[str, Any]) -> None:
    types = {
        operation["operationId"]: set(operation["responses"]["200"].get("content", ()))
        for operation in operations(spec)
        if "200" in operation["responses"]
    }
    arrays = {"application/octet-stream", "application/x-npz"}
    assert types["lift"] == types["get_reconstruction"] == {"application/json"} | arrays
    assert types["get_lift_result"] == {"application/x-ndjson"} | arrays
    assert types["download_weights"] == {"application/octet-stream"}
    assert types["stream_fit_events"] == {"text/event-stream"}


def test_every_answer_has_an_example_that_fits_it(spec: dict[str, Any]) -> None:
    schemas = spec["components"]["schemas"]
    named = {"Problem"}
    for operation in operations(spec):
        for response in operation["responses"].values():
            body = response.get("content", {}).get("application/json")
            if body is not None:
                named.add(body["schema"]["$ref"].rpartition("/")[2])
    assert len(named) > 10
    for name in named:
        kind = next(getattr(module, name) for module in MODULES if hasattr(module, name))
        TypeAdapter(kind).validate_python(schemas[name]["example"])


def test_examples_of_requests_work(api: TestClient, spec: dict[str, Any], model: str) -> None:
    example = {
        name: schema.get("example") for name, schema in spec["components"]["schemas"].items()
    }
    made = api.post("/datasets", json=example["DatasetCreate"])
    assert made.status_code == 201, made.text
    dataset = made.json()["id"]
    more = api.post(f"/datasets/{dataset}/frames", json=example["Frames"])
    assert more.status_code == 200, more.text
    fit = api.post("/fits", json=example["FitCreate"] | {"dataset_id": dataset})
    assert fit.status_code == 202, fit.text
    body = example["LiftCreate"] | {"dataset_id": dataset, "model_id": model}
    refused = api.post("/lifts", json=body)
    assert "16 keypoints as in the model" in refused.json()["detail"]  # all else is right
    lifted = api.post("/lift", json=example["LiftRequest"] | {"model": model})
    assert "expected 16 keypoints" in lifted.json()["detail"]  # all else is right


@pytest.mark.thorough
def test_a_generated_client_does_the_whole_job(
    live: Live, capture: SyntheticCapture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    programs = Path(sys.executable).parent
    target = tmp_path / "generated_fewview"
    options = ["--path", str(COMMITTED), "--output-path", str(target), "--meta", "none"]
    done = subprocess.run(
        [programs / "openapi-python-client", "generate", *options, "--fail-on-warning"],
        env=os.environ | {"PATH": f"{programs}:{os.environ['PATH']}"},  # it looks for ruff there
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "warning" not in (done.stdout + done.stderr).lower()

    monkeypatch.syspath_prepend(tmp_path)
    client = importlib.import_module("generated_fewview").Client(
        base_url=live.url, raise_on_unexpected_status=True
    )
    wire = importlib.import_module("generated_fewview.models")
    types = importlib.import_module("generated_fewview.types")

    def call(operation: str, *args: Any, **more: Any) -> Any:
        module = importlib.import_module(f"generated_fewview.api.{operation}")
        return module.sync(*args, client=client, **more)

    with client:
        frames = frames_of(capture.keypoints)
        body = wire.DatasetCreate(
            keypoints=frames[:30],
            name="generated",
            skeleton=wire.Skeleton(edges=[list(edge) for edge in capture.edges]),
        )
        dataset = call("datasets.create_dataset", body=body)
        assert (dataset.frames, dataset.views, dataset.keypoints) == (30, 3, 16)
        assert call("datasets.get_dataset", dataset.id).skeleton.edges == body.skeleton.edges

        # The same as bytes: raw, in a form, and appended.
        file = types.File(payload=io.BytesIO(to_npz(keypoints=capture.keypoints[:30])))
        assert call("datasets.create_dataset", body=file).checksum == dataset.checksum
        file = types.File(io.BytesIO(to_npz(keypoints=capture.keypoints[:30])), "c.npz")
        form = wire.DatasetCreateForm(file=file, name="form", metadata='{"a": 1}')
        made = call("datasets.create_dataset", body=form)
        assert (made.checksum, made.name) == (dataset.checksum, "form")
        assert made.metadata.to_dict() == {"a": 1}
        tables = [
            types.File(io.BytesIO(wide_csv(capture.keypoints[:30, view])), f"cam{view}.csv")
            for view in range(3)
        ]
        made = call("datasets.create_dataset", body=wire.DatasetCreateForm(files=tables))
        assert (made.frames, made.view_names) == (30, ["cam0", "cam1", "cam2"])
        assert made.notes == ["read as plain CSV"]
        file = types.File(payload=io.BytesIO(to_npz(keypoints=capture.keypoints[30:])))
        assert call("datasets.append_frames", dataset.id, body=file).frames == 60

        config = wire.FitConfig.from_dict(CONFIG)
        fit = call("fits.create_fit", body=wire.FitCreate(dataset_id=dataset.id, config=config))
        deadline = time.monotonic() + 300
        while fit.status in (wire.JobStatus.QUEUED, wire.JobStatus.RUNNING):
            assert time.monotonic() < deadline
            time.sleep(0.1)
            fit = call("fits.get_fit", fit.id)
        assert fit.status == wire.JobStatus.SUCCEEDED
        assert fit.progress.step == CONFIG["steps"]
        assert len(call("fits.get_reconstruction", fit.id).frames) == 60

        model = call("models.get_model", fit.model_id)
        assert model.reprojection_error > 0
        cameras = call("models.get_model_cameras", model.id)
        assert cameras.reason
        assert [view.index for view in cameras.views] == list(range(len(cameras.views)))
        assert call("models.list_models").items[0].id == model.id
        request = wire.LiftRequest(model=model.id, frames=[*frames[:2], [None] * 3])
        lifted = call("lift.lift", body=request)
        assert [str(frame.status) for frame in lifted.frames] == ["ok", "ok", "too_few_keypoints"]
        assert np.array(lifted.frames[0].points3d).shape == (16, 3)
        assert np.array(lifted.frames[0].views[0].rotation).shape == (3, 3)
        assert lifted.frames[2].views == [None] * 3
        file = types.File(payload=io.BytesIO(to_npz(frames=capture.keypoints[:2])))
        again = call("lift.lift", body=file, model=model.id)
        assert again.frames[0] == lifted.frames[0]
        file = types.File(payload=io.BytesIO(to_npz(frames=capture.keypoints[:2, 1:])))
        off = wire.Refine.OFF
        plain = call("lift.lift", body=file, model=model.id, refine=off, views=[1, 2])
        assert plain.frames[0].views[0].camera == "weak_perspective"
        assert len(call("fits.get_reconstruction", fit.id, refine=off).frames) == 60

        asked = wire.LiftCreate(model_id=model.id, dataset_id=dataset.id, refine=off)
        job = call("lifts.create_lift", body=asked)
        while job.status in (wire.JobStatus.QUEUED, wire.JobStatus.RUNNING):
            assert time.monotonic() < deadline + 300
            time.sleep(0.1)
            job = call("lifts.get_lift", job.id)
        assert job.progress.frames_done == 60
        found = call("lifts.get_lift_result", job.id, format_="safetensors")
        assert load(found.payload.getvalue())["points3d"].shape == (60, 16, 3)

        weights = call("models.download_weights", model.id).payload.getvalue()
        assert "curve" in load(weights)
        imported = call("models.import_model", body=types.File(payload=io.BytesIO(weights)))
        assert imported.weights_checksum == model.weights_checksum

        wrong = call("datasets.get_dataset", "ds_none")
        assert isinstance(wrong, wire.Problem)
        assert (wrong.status, wrong.code) == (404, "not_found")
        assert call("health.check_ready").queue.status == "ok"
    assert httpx2.get(f"{live.url}/models/{model.id}").status_code == 200
