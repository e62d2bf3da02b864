"""Every file that the API offers of a fit, its model and its dataset, for every kind of model."""

from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from safetensors.numpy import load_file
from starlette.testclient import TestClient

from models.capture.synthetic import EDGES, KEYPOINT_NAMES
from models.lifting.fitted_prior import FittedPrior
from models.settings.config import FitConfig
from models.training.trainer import fit
from service.settings import Settings
from store.database import Store
from tests.models.rigs import FOCAL, make_rig_capture
from tests.service.conftest import BYTES, CONFIG, problem, to_npz
from tests.service.stored_fits import put_fit
from tests.sharing import fitted_once

OWNERS = ("/fits/{fit_id}/", "/models/{model_id}/", "/datasets/{dataset_id}/")
NO_FILES = {"/fits/{fit_id}/events", "/datasets/{dataset_id}/corrections"}
NETWORK = "/models/{model_id}/network"
CAMERAS = ("/models/{model_id}/cameras", "/fits/{fit_id}/cameras")
FIXTURES = Path(__file__).parents[2] / "fixtures"


class Kind(NamedTuple):
    """A kind of model, the keypoints (N, K, P, 2) of its fit, and what it cannot give away."""

    prior: FittedPrior
    keypoints: NDArray[Any]
    no_poses: bool = False  # so it has no room, and no calibration of formats that have poses
    no_cameras: bool = False


def kept(name: str) -> Kind:
    """Return a prior of three static cameras that an older version fitted."""
    keypoints = load_file(FIXTURES / f"{name}_lifts.safetensors")["keypoints"]
    return Kind(FittedPrior.from_bytes((FIXTURES / f"{name}.safetensors").read_bytes()), keypoints)


def fitted(name: str, keypoints: NDArray[Any], **config: Any) -> Kind:
    settings = FitConfig.model_validate(CONFIG | config)
    return Kind(fitted_once(f"exports-{name}", lambda: fit(keypoints, settings)), keypoints)


def posed() -> Kind:
    """Return a fit to cameras whose lenses and poses were given."""
    capture = make_rig_capture([0, 120], frames=24)
    calibration = [
        {
            "intrinsics": {"fx": lens.focal, "cx": lens.centre[0], "cy": lens.centre[1]},
            "rotation": capture.rotations[0, view].tolist(),
            "translation": capture.translations[0, view].tolist(),
        }
        for view, lens in enumerate(capture.lenses)
    ]
    return fitted("posed", capture.keypoints, cameras="static", calibration=calibration)


def never_seen() -> Kind:
    """Return a fit to two views, none of which ever shows the head."""
    keypoints = make_rig_capture([0, 100], frames=24).keypoints
    keypoints[:, :, KEYPOINT_NAMES.index("head")] = np.nan
    lenses = [{"intrinsics": {"fx": FOCAL}}] * 2  # to look for them would take most of the time
    return fitted("never-seen", keypoints, cameras="static", calibration=lenses)


def moving() -> Kind:
    keypoints = make_rig_capture([0, 120], frames=24, moving=(0, 1)).keypoints
    return fitted("moving", keypoints)._replace(no_poses=True)


def one_view() -> Kind:
    keypoints = make_rig_capture([0], frames=24).keypoints
    return fitted("one-view", keypoints)._replace(no_poses=True, no_cameras=True)


KINDS: dict[str, Callable[[], Kind]] = {
    "static": partial(kept, "resting"),
    "fisheye, given lenses": partial(kept, "fisheye"),
    "without noise": partial(kept, "denoised"),
    "never refined": lambda: kept("plain")._replace(no_poses=True, no_cameras=True),
    "given cameras": posed,
    "a keypoint never seen": never_seen,
    "moving": moving,
    "one view": one_view,
}
# It takes seconds to export: test_models.py downloads one, and all kinds of networks are in
# tests/models/lifting/test_onnx_file.py.
WITH_NETWORK = ("without noise",)


def may_be_refused(kind: Kind, path: str, query: str) -> bool:
    if path == NETWORK:
        return kind.prior.denoises
    if path in CAMERAS and "json" not in query:
        return kind.no_cameras or (kind.no_poses and "anipose" in query)
    return kind.no_poses and "frame=room" in query


@pytest.mark.parametrize("name", list(KINDS))
def test_everything_can_be_taken_away(name: str, api: TestClient, settings: Settings) -> None:
    kind = KINDS[name]()
    views, count = kind.keypoints.shape[1:3]
    skeleton = {
        "keypoint_names": list(KEYPOINT_NAMES[:count]),
        "edges": [list(edge) for edge in EDGES if max(edge) < count],
    }
    sizes = np.full((views, 2), (1280, 1024))
    body = to_npz(keypoints=kind.keypoints, image_sizes=sizes, **skeleton)
    made = api.post("/datasets?name=exported", content=body, headers=BYTES)
    assert made.status_code == 201, made.text
    dataset = made.json()["id"]
    with closing(Store(settings)) as records:
        fit_id = put_fit(records, dataset, kind.prior, kind.keypoints, skeleton=skeleton)
    model = api.get(f"/fits/{fit_id}").json()["model_id"]
    for path, query in exports(api.get("/openapi.json").json()):
        if path == NETWORK and name not in WITH_NETWORK:
            continue
        where = path.format(fit_id=fit_id, model_id=model, dataset_id=dataset)
        answer = api.get(f"{where}?{query}")
        refused = may_be_refused(kind, path, query)
        assert answer.status_code == (409 if refused else 200), f"{path}?{query}: {answer.text}"
        if refused:
            problem(answer, 409, "conflict")
        else:
            assert len(answer.content) > 100, f"{path}?{query}"


def exports(document: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the path and query of every export that an OpenAPI document has, in every format."""
    for path, operations in document["paths"].items():
        if not path.startswith(OWNERS) or path in NO_FILES or "get" not in operations:
            continue
        queries = [""]
        for parameter in operations["get"].get("parameters", []):
            if parameter["name"] == "format":
                queries = [f"format={name}" for name in names_in(parameter["schema"], document)]
            elif parameter["name"] == "unit":
                queries = [f"{query}&unit=m" for query in queries]
            elif parameter["name"] == "images":
                queries = [f"{query}&images=all" for query in queries]
            elif parameter["name"] == "frame":
                queries += [f"{query}&frame=room&up=0,-1,0" for query in queries]
        yield from ((path, query) for query in queries)


def names_in(schema: dict[str, Any], document: dict[str, Any]) -> list[str]:
    """Return the words that a schema allows."""
    if "$ref" in schema:
        schema = document["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
    found = list(schema.get("enum", []))
    for part in schema.get("anyOf", []):
        found += names_in(part, document)
    return found
