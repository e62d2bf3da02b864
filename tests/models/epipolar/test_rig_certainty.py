"""Certainty of static cameras: against the scatter of estimates, and known errors."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from models.epipolar.pairs import Beliefs
from models.epipolar.rig_adjustment import adjust_rig
from models.epipolar.rig_certainty import certainty_of
from models.epipolar.static_cameras import SeenPoints, StaticCameras
from tests.models.rigs import around

Float64 = NDArray[np.float64]

NOISE = 2e-3  # sides
POINTS = 800
FOCALS = np.array([1.0, 1.3, 0.8])
BELIEFS = Beliefs(
    np.full(3, 1.1),
    0.5**2 * np.eye(3),
    0.02**2 * np.eye(3),
    np.stack((0.1**2 * np.eye(3), 0.05**2 * np.eye(3))),
)
APART = (np.arange(POINTS), np.arange(POINTS))  # clusters of points that err independently


def make_rig(centres: Float64 | None = None) -> StaticCameras:
    rotations, translations = around([0.0, 80.0, -120.0])
    middles = np.zeros((3, 2)) if centres is None else centres
    return StaticCameras(np.log(FOCALS), middles, np.zeros((3, 2)), rotations, translations)


def points_of(rng: np.random.Generator) -> Float64:
    return rng.uniform(-1, 1, (3, POINTS))


def images_of(rig: StaticCameras, points: Float64) -> Float64:
    camera = rig.rotations @ points + rig.translations[..., None]
    flat = camera[:, :2] / camera[:, 2:]
    return np.asarray(FOCALS[:, None, None] * flat + rig.centres[..., None])


def test_deviations_are_the_scatter_of_what_is_found() -> None:
    turns, focals, sds = [], [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rig = make_rig(0.02 * rng.standard_normal((3, 2)))  # as believed
        points = points_of(rng)
        clean = images_of(rig, points)
        seen = SeenPoints(clean + NOISE * rng.standard_normal(clean.shape), np.ones((3, POINTS)))
        start = rig._replace(centres=np.zeros((3, 2)))
        found = adjust_rig(start, points, seen, BELIEFS, iterations=25)
        relative = found.rig.rotations @ rig.rotations.mT
        turns.append(relative[:, [2, 0, 1], [1, 2, 0]] - relative[:, [1, 2, 0], [2, 0, 1]])
        focals.append(found.rig.log_focals - np.log(FOCALS))
        sds.append(certainty_of(found, seen, BELIEFS, APART).deviations)
    expected = np.mean(sds, 0)
    assert (expected[0, 5:] == 0).all()  # the first camera is the frame of reference
    np.testing.assert_allclose(np.sqrt(np.square(focals).mean(0)), expected[:, 0], rtol=0.6)
    scatter = np.sqrt(np.square(turns).mean(0))[1:] / 2
    np.testing.assert_allclose(scatter, expected[1:, 5:8], rtol=0.6)


def test_the_likelihood_of_focal_lengths_does_not_depend_on_the_prior() -> None:
    rig, rng = make_rig(), np.random.default_rng(1)
    points = points_of(rng)
    clean = images_of(rig, points)
    seen = SeenPoints(clean + NOISE * rng.standard_normal(clean.shape), np.ones((3, POINTS)))
    wrong = replace(BELIEFS, focals=1.1 * FOCALS, focal_covariance=0.01**2 * np.eye(3))
    message, sds = [], []
    for beliefs in (BELIEFS, wrong):
        found = adjust_rig(rig, points, seen, beliefs, iterations=25)
        information, vector = certainty_of(found, seen, beliefs, APART).focals
        message.append(np.linalg.solve(information, vector))
        sds.append(np.sqrt(np.linalg.inv(information).diagonal()))
    assert (np.abs(message[0] - np.log(FOCALS)) < 2.5 * sds[0]).all()
    assert (np.abs(message[1] - message[0]) < 0.7 * sds[0]).all()
    np.testing.assert_allclose(sds[1], sds[0], rtol=0.2)


@pytest.mark.parametrize("alike", [8, 40])
def test_errors_that_repeat_make_cameras_less_certain(alike: int) -> None:
    """What is found scatters as deviations say, where so many points err alike."""
    rig, clusters = make_rig(), np.arange(POINTS) // alike
    focals, sds = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        # Points of a cluster lie together, as a frame's do, so that they pull together.
        places = rng.uniform(-1, 1, (3, POINTS // alike))
        points = places[:, clusters] + 0.05 * rng.standard_normal((3, POINTS))
        errors = NOISE * rng.standard_normal((3, 2, POINTS // alike))[..., clusters]
        seen = SeenPoints(images_of(rig, points) + errors, np.ones((3, POINTS)))
        found = adjust_rig(rig, points, seen, BELIEFS, iterations=25, lenses=False)
        focals.append(found.rig.log_focals - np.log(FOCALS))
        certainty = certainty_of(found, seen, BELIEFS, (clusters, np.arange(POINTS)))
        sds.append(certainty.deviations[:, 0])
    scores = np.array(focals) / np.array(sds)
    assert 0.4 < np.sqrt(np.square(scores).mean()) < 1.6
