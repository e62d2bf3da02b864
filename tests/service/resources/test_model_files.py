"""Files of models that are none, or contradict themselves, are refused; lists stay short."""

import io
import pickle
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
from safetensors.numpy import load, save
from starlette.testclient import TestClient

from models.findings.finding import Finding, dumped
from models.lifting.fitted_prior import FittedPrior
from models.numerics.tensor_files import WeightsError
from models.settings.config import FitConfig
from service.settings import Settings
from tests.service.conftest import (
    BYTES,
    CONFIG,
    JSON,
    problem,
    to_npz,
    to_safetensors,
)

FIXTURES = Path(__file__).parents[2] / "fixtures"


@pytest.mark.usefixtures("unchanged")
def test_what_a_file_says_of_its_model_is_checked(api: TestClient, weights: bytes) -> None:
    arrays, metadata = load(weights), {"fewview": orjson.dumps(about_of(weights)).decode()}
    for message, pointer in (
        ("{", ""),
        ("[" * 100_000, ""),
        ("7", ""),
        ('{"views": "3"}', "/views"),
        ('{"views": 0}', "/views"),
        ('{"frames": 1e99}', "/frames"),
        (f'{{"version": "{"1" * 101}"}}', "/version"),
        ('{"name": ["a"]}', "/name"),
        (f'{{"name": "{"a" * 201}"}}', "/name"),
        ('{"metrics": {"pck": "much"}}', "/metrics/pck"),
        ('{"tags": [" "]}', "/tags/0"),
        ('{"metrics": {"pa_mpjpe": NaN}}', "/metrics/pa_mpjpe"),
        ('{"skeleton": {"edges": [[0, 1, 2]]}}', "/skeleton/edges/0"),
        ('{"skeleton": {"edges": [[0, 99]]}}', "/skeleton/edges/0"),
        ('{"skeleton": {"keypoint_names": ["a"]}}', "/skeleton/keypoint_names"),
    ):
        data = save(arrays, metadata | {"model": message})
        response = api.post("/models", content=data, headers=BYTES)
        problem(response, 422, "invalid_input", pointer)
    huge = save(arrays, metadata | {"model": f'{{"name": "{"a" * 1_000_000}"}}'})
    problem(api.post("/models", content=huge, headers=BYTES), 400, "malformed_body")
    for text in (b'"model":7', b'"model":"\\ud800"'):
        data = weights.replace(b'"__metadata__":{', b'"__metadata__":{' + text + b",", 1)
        size = int.from_bytes(weights[:8], "little") + len(text) + 1
        response = api.post("/models", content=size.to_bytes(8, "little") + data[8:], headers=BYTES)
        assert response.status_code in (400, 422), response.text


def damaged(weights: bytes) -> dict[str, bytes]:
    arrays = load(weights)
    about = about_of(weights)
    config = FitConfig.model_validate(CONFIG)
    wider = config.model_copy(update={"dictionary_sizes": (32, 8)}).model_dump_json()
    not_finite = {name: array.copy() for name, array in arrays.items()}
    next(array for array in not_finite.values() if array.size).flat[0] = np.nan
    header = len(weights) - sum(array.nbytes for array in arrays.values()) - 8
    return {
        "empty": b"",
        "short": weights[:5],
        "cut in its header": weights[: header // 2],
        "cut in its arrays": weights[:-100],
        "too long": weights + b"\0",
        "huge header": (2**62).to_bytes(8, "little") + weights[8:],
        "pickle": pickle.dumps({"weights": [1, 2, 3]}),
        "zip": to_npz(**arrays),
        "no metadata": save(arrays),
        "a capture": to_safetensors(keypoints=np.zeros((1, 2, 4, 2), np.float32)),
        "another kind": rewritten(arrays, about | {"kind": "checkpoint"}),
        "another format": rewritten(arrays, about | {"format": "fewview/99"}),
        "config of another size": rewritten(arrays, about | {"config": wider}),
        "foreign metadata": save(arrays, {"fewview": "[1]"}),
        "no config": rewritten(arrays, {k: v for k, v in about.items() if k != "config"}),
        "absurd config": rewritten(arrays, about | {"config": '{"steps": -1}'}),
        "other keypoints": rewritten(arrays, about | {"keypoints": "17"}),
        "absurd keypoints": rewritten(arrays, about | {"keypoints": "1000000000"}),
        "an array is missing": rewritten(dict(list(arrays.items())[1:]), about),
        "an array too many": rewritten({**arrays, "more": np.zeros(1, np.float32)}, about),
        "not finite": rewritten(not_finite, about),
        "integers": rewritten({k: v.astype(np.int32) for k, v in arrays.items()}, about),
    }


def test_a_file_agrees_with_itself(api: TestClient, weights: bytes) -> None:
    """Its parts are of as many views, its limits are numbers, its curve is one of a fit."""
    arrays, about = load(weights), about_of(weights)
    denoised = (FIXTURES / "denoised.safetensors").read_bytes()
    others, answer = load(denoised), about_of(denoised)
    refused: dict[str, bytes] = {}
    for usual in ("[[NaN], 1, 2]", "[[], 1, 2]", "[[-1], 1, 2]", "[[1], NaN, 2]", "[[1], 3, 2]",
                  "[[1], Infinity, Infinity]", "[[1], 1, NaN]", "[[1" + "0" * 400 + "], 1, 2]",
                  "[[1], -1, 2]", f"[{[1] * 65}, 1, 2]"):  # fmt: skip
        refused[f"usual {usual}"] = rewritten(arrays, about | {"usual": usual})
    for views in ("-1", "2", "65", "1" + "0" * 400):
        refused[f"views {views}"] = rewritten(arrays, about | {"views": views})
    whole = {"known": "1" * int(answer["keypoints"]), "places": "[]", "usual": "[[1], 1, 2]"}
    refused["noise of other views"] = rewritten(
        others, answer | whole | {"views": "9", "findings": "[]"}
    )
    refused["places of no view"] = rewritten(arrays, about | {"places": "[[3, 0, 1.0, 1.0]]"})
    refused["places beyond all"] = rewritten(
        arrays, about | {"places": f"[[0, 0, 1{'0' * 400}, 1.0]]"}
    )
    noticed = dumped([Finding.of("views_identical", views=[0, 1])])[0]
    for what, text in {"NaN": "NaN", "infinity": "1e999", "null": "null"}.items():
        odd = orjson.dumps(noticed | {"evidence": {"a": 0.5}}).decode().replace("0.5", text)
        refused[f"evidence {what}"] = rewritten(arrays, about | {"findings": f"[{odd}]"})
    odd = orjson.dumps(noticed | {"effect": "half"}).decode().replace("half", "\\ud800")
    refused["half a character"] = rewritten(arrays, about | {"findings": f"[{odd}]"})
    words = orjson.dumps(
        {"reason": "why", "findings": [noticed], "lenses": ["pinhole"] * 3}
    ).decode()
    for was, text in (("why", "\\ud800"), (noticed["effect"], "\\udfff")):
        data = rewritten(arrays, about | {"cameras": words.replace(was, text)})
        refused[f"cameras that say {text}"] = data
    for what, curve in {
        "long": np.cumsum(np.ones((900_000, 3)), 0),
        "falling": np.array([[2.0, 1, 1], [1, 1, 1]]),
        "of halves": np.array([[0.5, 1, 1]]),
        "endless": np.array([[1e300, 1, 1]]),
    }.items():
        refused[f"curve {what}"] = rewritten(arrays | {"curve": curve}, about)
    for name in [name for name in arrays if name.startswith(("cameras.", "outliers."))]:
        cut = np.ascontiguousarray(arrays[name][:1])
        if (
            arrays[name].ndim
            and len(arrays[name]) == 3
            and "doubt" not in name
            and "shape" not in name
        ):
            refused[f"one view of {name}"] = rewritten(arrays | {name: cut}, about)
    for name, (tensors, header) in {
        "denoiser.noise": (others, answer),
        "cameras.doubt_basis": (arrays, about),
    }.items():
        beyond = np.full_like(tensors[name], 1e30)
        refused[f"{name} beyond all use"] = rewritten(tensors | {name: beyond}, header)
    for what, data in refused.items():
        if len(data) > 4 * 1024 * 1024:
            with pytest.raises(WeightsError):
                FittedPrior.from_bytes(data)
            continue
        response = api.post("/models", content=data, headers=BYTES)
        assert response.status_code == 400, (what, response.text)
        problem(response, 400, "malformed_body")


def about_of(weights: bytes) -> dict[str, str]:
    size = int.from_bytes(weights[:8], "little")
    metadata = orjson.loads(weights[8 : 8 + size])["__metadata__"]
    about: dict[str, str] = orjson.loads(metadata["fewview"])
    return about


def rewritten(arrays: dict[str, Any], about: dict[str, str]) -> bytes:
    return save(arrays, {"fewview": orjson.dumps(about).decode()})


def test_lists_read_no_curves(api: TestClient, settings: Settings, weights: bytes) -> None:
    """Whatever curve an older version took in, only who asks for the model is given it."""
    made = api.post("/models", content=weights, headers=BYTES).json()
    for curve in ("no JSON", "[]"):
        with sqlite3.connect(settings.data_dir / "records.db") as records:
            given = (curve, made["id"])
            records.execute("UPDATE models SET training_curve = ? WHERE id = ?", given)
        assert made["id"] in [one["id"] for one in api.get("/models?limit=200").json()["items"]]
    assert api.delete(f"/models/{made['id']}").status_code == 204


@pytest.mark.usefixtures("unchanged")
def test_damaged_weights_are_refused(api: TestClient, weights: bytes) -> None:
    FittedPrior.from_bytes(rewritten(load(weights), about_of(weights)))  # the undamaged one
    for what, data in damaged(weights).items():
        response = api.post("/models", content=data, headers=BYTES)
        assert response.status_code == 400, what
        problem(response, 400, "malformed_body")


@pytest.mark.usefixtures("unchanged")
def test_the_description_of_weights_is_checked(api: TestClient, weights: bytes) -> None:
    file = {"file": ("w", io.BytesIO(weights))}
    skeleton = {"skeleton": '{"edges": [[0, 16]]}'}
    problem(
        api.post("/models", data=skeleton, files=file), 422, "invalid_input", "/skeleton/edges/0"
    )
    file = {"file": ("w", io.BytesIO(weights))}
    problem(api.post("/models", data={"x": "1"}, files=file), 422, "invalid_input", "/x")
    problem(api.post("/models?name=", content=weights, headers=BYTES), 422, "invalid_input")
    problem(api.post("/models", content=b"{}", headers=JSON), 415, "unsupported_media_type")
