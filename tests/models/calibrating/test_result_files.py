"""Self-calibrations as tensors and text: what is written is read, and damage is named."""

import json

import numpy as np
import pytest
import torch

from models.bundle.problem import VIEW, make_rig
from models.bundle.shape_model import NetworkErrors, ShapeModel
from models.calibrating.result import SelfCalibration, camera_report
from models.calibrating.result_files import array_shapes, from_arrays, to_arrays
from models.findings.finding import Finding
from models.network.settling import settle_beyond
from models.numerics.tensor_files import Arrays, WeightsError
from models.optics.lenses.projection import COEFFICIENTS, LENSES, Lenses

VIEWS, KEYPOINTS = 3, 5


@pytest.fixture
def written() -> tuple[Arrays, str]:
    return to_arrays(calibration())


def calibration() -> SelfCalibration:
    """Make numbers without meaning; every camera model is among the lenses."""
    rng = np.random.default_rng(0)
    lenses = Lenses(
        rng.uniform(500, 900, (VIEWS, 2)),
        rng.uniform(300, 500, (VIEWS, 2)),
        rng.normal(0, 0.1, (VIEWS, COEFFICIENTS)),
        (np.arange(VIEWS) % len(LENSES)).astype(np.int8),
    )
    poses = np.tile(np.eye(3), (VIEWS, 1, 1)), rng.standard_normal((VIEWS, 3))
    return SelfCalibration(
        make_rig(lenses, np.array([0, 0, 1]), *poses, np.array([False, False, True])),
        rng.uniform(0, 1, (VIEWS, VIEW)),
        ShapeModel(
            rng.standard_normal((KEYPOINTS, 3)), rng.standard_normal((KEYPOINTS, 3, 2)), 0.1
        ),
        NetworkErrors(rng.standard_normal((KEYPOINTS, 3, 1)), 0.2, np.array([0.3, 0.2])),
        settle_beyond(0.7),
        1.5,
        2.5,
        rng.uniform(0, 1, VIEWS),
        "why",
        (Finding.of("calibration_disagrees", views=[1], noise=2.0),),
        handedness_certainty=0.75,
    )


def test_what_is_written_is_read(written: tuple[Arrays, str]) -> None:
    arrays, words = written
    shapes = array_shapes(words, KEYPOINTS, VIEWS)
    assert shapes.keys() == arrays.keys()
    for name, array in arrays.items():
        assert all(a in (b, None) for a, b in zip(shapes[name], array.shape, strict=True)), name
    again, words_again = to_arrays(from_arrays(arrays, words))
    assert words_again == words
    for name, array in arrays.items():
        assert torch.equal(again[name], array), name
    report = camera_report(from_arrays(arrays, words))
    assert report.camera_models == tuple(LENSES[k % len(LENSES)].LIFTED_AS for k in range(VIEWS))
    assert report.arrangement == "mixed"


def test_older_files_name_no_camera_models_but_flag_fisheyes(written: tuple[Arrays, str]) -> None:
    arrays, words = written
    answer = json.loads(words)
    del answer["lenses"]
    older = arrays | {"fisheye": torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)}
    assert array_shapes(json.dumps(answer), KEYPOINTS, None).keys() == older.keys()
    read = camera_report(from_arrays(older, json.dumps(answer)))
    assert read.camera_models == ("perspective", "fisheye", "perspective")


def test_older_files_know_one_radial_coefficient(written: tuple[Arrays, str]) -> None:
    arrays, words = written
    deviations = arrays["deviations"]
    older = arrays | {"deviations": torch.cat((deviations[:, :4], deviations[:, 5:]), 1)}
    read = from_arrays(older, words)
    assert (read.deviations[:, 4] == 0).all()
    kept = np.delete(read.deviations, 4, axis=1)
    np.testing.assert_array_equal(kept, older["deviations"].numpy())
    with pytest.raises(WeightsError, match="contradicts"):
        from_arrays(arrays | {"deviations": deviations[:, :7]}, words)


def test_warnings_of_older_files_become_findings(written: tuple[Arrays, str]) -> None:
    arrays, words = written
    answer = json.loads(words)
    del answer["findings"]
    answer["warnings"] = ["the given poses do not fit the keypoints: noise 9 px", "something else"]
    (finding,) = from_arrays(arrays, json.dumps(answer)).findings
    assert finding.code == "calibration_disagrees"


@pytest.mark.parametrize(
    "change",
    [
        {"lenses": ["pinhole", "mirror", "pinhole"]},
        {"lenses": ["pinhole"]},
        {"reason": 1},
        {"findings": ["bad"]},
    ],
)
def test_text_that_was_not_written_is_refused(
    written: tuple[Arrays, str], change: dict[str, object]
) -> None:
    arrays, words = written
    with pytest.raises(WeightsError):
        from_arrays(arrays, json.dumps(json.loads(words) | change))


@pytest.mark.parametrize("name", ["focals", "groups", "deviations"])
def test_views_that_are_missing_are_noticed(written: tuple[Arrays, str], name: str) -> None:
    arrays, words = written
    with pytest.raises(WeightsError, match="contradicts itself"):
        from_arrays(arrays | {name: arrays[name][:-1]}, words)
