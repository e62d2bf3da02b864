"""What the benchmark of doubt counts: on answers whose covariance is known, shares are nominal."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.coverage import covariance_of, held, ratio_scores, shares
from benchmarks.doubt import LEVELS, Row, curves, summary
from benchmarks.harmed_frames import HARMS, area_under_curve, errors_of, harmed
from benchmarks.real_cells import GAPS, SPOILT, spoil
from benchmarks.reliability import draw_reliability

Float64 = NDArray[np.float64]

POINTS, FRAMES = 12, 400
SOME = np.arange(POINTS) < 8  # the points that align where not all do


def drawn(rng: np.random.Generator) -> tuple[Float64, Float64, Float64]:
    """Draw a truth in its own place, turn and size, an answer, and the answer's covariance."""
    structure = rng.standard_normal((POINTS, 3))
    modes = 2e-3 * rng.standard_normal((POINTS, 3, 4))
    own = 1e-3 * np.exp(0.5 * rng.standard_normal((POINTS, 3)))
    off = modes @ rng.standard_normal(4) + own * rng.standard_normal((POINTS, 3))
    whole = np.einsum("pir,pjr->pij", modes, modes) + own[..., None] ** 2 * np.eye(3)
    blocks = whole[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    truth = 3 * structure @ Rotation.random(random_state=rng).as_matrix() + [5, -2, 1]
    return truth, structure + off, covariance_of(blocks, modes)


@pytest.mark.parametrize("aligning", [np.ones(POINTS, bool), SOME], ids=["all", "some"])
def test_as_many_points_as_should_are_within_the_ellipsoids(aligning: NDArray[np.bool_]) -> None:
    rng = np.random.default_rng(0)
    frames = [held(answer, truth, s, aligning) for truth, answer, s in map(drawn, [rng] * FRAMES)]

    for which in (aligning, ~aligning):
        if which.any():
            distances = np.concatenate([frame.distances[which] for frame in frames])
            np.testing.assert_allclose(shares(distances, 3, LEVELS), LEVELS, atol=0.03)
            errors, expected = (
                np.concatenate([getattr(frame, name)[which] for frame in frames])
                for name in ("errors", "expected")
            )
            assert np.square(errors).mean() == pytest.approx(np.square(expected).mean(), rel=0.05)


def test_as_many_ratios_as_should_are_near_the_true_ones() -> None:
    rng = np.random.default_rng(0)
    scores = [
        ratio_scores(answer, truth, s, rng) for truth, answer, s in map(drawn, [rng] * FRAMES)
    ]
    np.testing.assert_allclose(shares(np.concatenate(scores), 1, LEVELS), LEVELS, atol=0.04)


def test_deviations_that_are_too_small_hold_less_often() -> None:
    rng = np.random.default_rng(0)
    every = np.ones(POINTS, bool)
    frames = [held(a, truth, s / 4, every) for truth, a, s in map(drawn, [rng] * FRAMES)]
    assert shares(np.concatenate([f.distances for f in frames]), 3, (0.68,))[0] < 0.4


def test_common_modes_are_part_of_the_covariance() -> None:
    _, _, whole = drawn(np.random.default_rng(1))
    apart = whole.reshape(POINTS, 3, POINTS, 3)[0, :, 1]
    assert np.abs(apart).max() > 0
    assert np.linalg.eigvalsh(whole).min() > 0


def test_every_harm_has_a_run_of_its_own() -> None:
    rng = np.random.default_rng(0)
    keypoints = rng.uniform(0, 1000, (200, 3, 9, 2))
    spoilt = harmed(keypoints, rng)

    changed = (spoilt != keypoints).any((1, 2, 3))
    assert changed.sum() == len(HARMS) * 10
    views = np.isfinite(spoilt).any((2, 3)).sum(1)
    assert (views == 1).sum() == 10
    assert np.isfinite(keypoints).all()


def test_the_area_under_the_curve_counts_ties_half() -> None:
    which = np.array([True, True, False, False])
    assert area_under_curve(np.array([3.0, 2.0, 1.0, 0.0]), which) == 1
    assert area_under_curve(np.array([0.0, 1.0, 2.0, 3.0]), which) == 0
    assert area_under_curve(np.ones(4), which) == 0.5
    assert np.isnan(area_under_curve(np.ones(4), np.zeros(4, bool)))


def test_errors_are_shares_of_the_size_of_what_a_frame_has() -> None:
    truth, answer, _ = drawn(np.random.default_rng(0))
    answer[-1] = np.nan
    alone = errors_of(answer[None], truth[None])
    assert 0 < alone[0] < 0.01
    np.testing.assert_allclose(errors_of(7 * answer[None] + 1, truth[None]), alone)


def test_noise_is_a_share_of_the_height_in_the_image() -> None:
    rng = np.random.default_rng(0)
    keypoints = 100 * rng.standard_normal((300, 2, 10, 2))
    height = 4 * np.median(np.sqrt(keypoints.var(2).sum(-1)))
    for name, (share, _) in SPOILT.items():
        off = spoil(keypoints, name) - keypoints
        assert np.nanstd(off) == pytest.approx(share * height, rel=0.06, abs=1e-9)
        assert np.isnan(off).mean() == pytest.approx(0.3 if name == GAPS else 0, abs=0.02)


def row(half: str, views: int, points: list[float]) -> Row:
    unknown = float("nan")
    return Row(
        "0", "", half, views, points, points, unknown, unknown, 0.5, 0.01, 0.02, 0.05, 0.9, 0.8
    )


def test_the_summary_and_the_picture_have_the_medians(tmp_path: Path) -> None:
    good, wide = list(LEVELS), [0.99] * len(LEVELS)
    rows = [row("setting", 2, good), row("setting", 3, wide), row("looking", 4, good)]

    every, pairs, more = summary(rows, "draws")
    assert (every["68 % is 53 to 83"], pairs["68 % is 53 to 83"]) == ("67%", "100%")
    assert every["points in 50 / 68 / 95 %"] == "50% 68% 95%"
    assert (more["one view"], more["error / expected"]) == ("", "0.50")

    found = curves(rows)
    assert {curve.label for curve in found} == {"setting", "looking"}
    np.testing.assert_allclose(found[0].observed, np.mean([good, wide], 0))
    drawn_to = tmp_path / "picture.svg"
    draw_reliability(LEVELS, found, drawn_to)
    first = drawn_to.read_bytes()
    text = " ".join(ElementTree.fromstring(first).itertext())  # noqa: S314  # made here
    assert all(words in text for words in ("nominal, %", "setting", "log ratios of two lengths"))
    draw_reliability(LEVELS, found, drawn_to)
    assert drawn_to.read_bytes() == first
