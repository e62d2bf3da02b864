"""Fits of captures whose views are out of step."""

import numpy as np
import pytest
from numpy.typing import NDArray

from models.lifting.fitted_prior import FittedPrior
from models.settings.config import FitConfig
from models.training.synchronising import put_in_step
from models.training.trainer import Trainer, fit
from tests.models.epipolar.test_order_checks import partners
from tests.models.walk import film

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

RING = [0.0, 70.0, 160.0]
FRAMES = 200
MOMENTS = np.arange(20.0, 20 + FRAMES)[:, None]
TIMES = 1.7e9 + np.arange(FRAMES) / 50
# Looking for static cameras would take most of the time, and has nothing to do with clocks.
QUICK = FitConfig(dictionary_sizes=(16, 8), steps=3, batch_size=8, cameras="moving")


def filmed(*late: float, noise: float = 0.0) -> Float32:
    return film(RING, MOMENTS - np.array(late), noise=noise).astype(np.float32)


def distances(keypoints: Float32, *, within: slice = slice(15, -15)) -> Float64:
    """Pixels (N, K, P) from what the views show in step."""
    apart = np.linalg.norm(keypoints.astype(np.float64) - filmed(0, 0, 0), axis=-1)
    return np.asarray(apart[within], np.float64)


def test_a_late_view_is_shifted_where_times_are_given() -> None:
    for late in (4.0, -6.5):
        read = put_in_step(filmed(0, late, 0), None, TIMES, "auto")
        assert distances(read.keypoints).max() < 0.15
        assert distances(filmed(0, late, 0)).max() > 5
        [finding] = read.findings
        assert (finding.code, finding.views, finding.severity) == (
            "views_out_of_step",
            (1,),
            "info",
        )
        answer = finding.evidence
        assert answer["offset_frames"] == pytest.approx(late, abs=0.05)
        assert answer["offset_seconds"] == pytest.approx(late / 50, abs=0.001)
        assert (answer["sure"], answer["applied"]) == (1, 1)
        assert read.clocks is not None


def test_it_is_only_reported_without_times() -> None:
    keypoints = filmed(0, 4, 0)
    read = put_in_step(keypoints, None, None, "auto")
    assert read.keypoints is keypoints
    assert read.clocks is None
    [finding] = read.findings
    assert (finding.views, finding.severity, finding.evidence["applied"]) == ((1,), "warning", 0)


def test_nothing_is_found_or_changed_without_reason() -> None:
    shuffled = np.random.default_rng(0).permutation(filmed(0, 4, 0))
    for keypoints, times, mode in (
        (shuffled, None, "auto"),
        (filmed(0, 0, 0, noise=3), TIMES, "auto"),
        (filmed(0, 0, 0, noise=3), None, "auto"),
        (filmed(0, 4, 0), TIMES, "off"),
        (filmed(0, 4, 0)[:10], TIMES[:10], "auto"),
    ):
        read = put_in_step(keypoints, None, times, mode)  # type: ignore[arg-type]
        np.testing.assert_array_equal(read.keypoints, keypoints)
        assert read.findings == ()
        assert read.clocks is None


def test_what_only_looks_late_is_not_called_so() -> None:
    moved = filmed(0, 0, 0)
    moved[80:, 1] += 60
    other_side = filmed(0, 0, 0, noise=10)
    other_side[:, 1] = other_side[:, 1][:, partners()]
    for keypoints in (moved, other_side):
        assert not put_in_step(keypoints, None, None, "auto").findings


def test_times_of_the_views_are_honoured_even_where_nothing_is_looked_for() -> None:
    times = TIMES[:, None] + np.array([0, 0.05, 0])  # the second view's frames were taken later
    for mode in ("auto", "off"):
        read = put_in_step(filmed(0, -2.5, 0), None, times, mode)
        assert distances(read.keypoints).max() < 0.15
        assert read.findings == ()


def test_frames_that_are_missing_do_not_count_as_time() -> None:
    kept = np.sort(np.random.default_rng(0).permutation(FRAMES)[: FRAMES * 9 // 10])
    read = put_in_step(filmed(0, 5, 0)[kept], None, TIMES[kept], "auto")
    [finding] = read.findings
    assert finding.evidence["offset_frames"] == pytest.approx(5, abs=0.05)
    apart = np.linalg.norm(read.keypoints - filmed(0, 0, 0)[kept], axis=-1)
    assert np.isfinite(apart[15:-15]).mean() > 0.9
    assert np.nanmax(apart[15:-15]) < 2


def test_dropped_frames_are_reported_with_the_frame() -> None:
    moments = MOMENTS + np.zeros(3)
    moments[110:, 2] += 3
    keypoints = film(RING, moments).astype(np.float32)
    [finding] = put_in_step(keypoints, None, TIMES, "auto").findings
    assert finding.views == (2,)
    assert finding.evidence["changes_from"] == pytest.approx(109, abs=4)
    assert finding.evidence["last_offset_frames"] == pytest.approx(-3, abs=0.2)


def test_the_prior_keeps_clocks_and_findings() -> None:
    config = QUICK.model_copy(update={"refine": "off"})
    prior = fit(filmed(0, 4, 0), config, times=TIMES)
    again = FittedPrior.from_bytes(prior.to_bytes())
    for found in (prior, again):
        clocks = found.capture.clocks_of(None, 3)
        assert clocks is not None
        np.testing.assert_allclose(clocks.offsets, [[0, 0.08, 0]], atol=1e-6)
        swapped = found.capture.clocks_of([1, 0], 3)
        assert swapped is not None
        np.testing.assert_allclose(swapped.offsets, [[0.08, 0]], atol=1e-6)
        assert found.capture.clocks_of(None, 2) is None
        assert "views_out_of_step" in [finding.code for finding in found.findings]


@pytest.mark.thorough
def test_a_fit_of_a_late_view_is_that_of_the_view_in_step() -> None:
    mended = fit(filmed(0, 4, 0)[4:-4], QUICK, times=TIMES[4:-4])
    in_step = fit(put_in_step(filmed(0, 4, 0)[4:-4], None, TIMES[4:-4], "auto").keypoints, QUICK)
    for name, weight in mended.weights.items():
        assert weight.equal(in_step.weights[name])


def test_times_are_checked() -> None:
    for times in (TIMES[::-1], TIMES[1:], np.stack((TIMES, TIMES), 1)):
        with pytest.raises(ValueError, match="times must"):
            Trainer(filmed(0, 0, 0), QUICK, times=times)
