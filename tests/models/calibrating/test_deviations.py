"""Standard deviations of cameras against errors, on a few drawn rigs; the benchmark has many."""

import numpy as np
import pytest

from benchmarks.deviations import Kind, draw, found_by, scores


@pytest.mark.parametrize("kind", [Kind(3), Kind(3, moving=(0, 1, 2))], ids=str)
def test_errors_are_as_large_as_they_are_said_to_be(kind: Kind) -> None:
    parts = []
    for seed in range(2):
        capture = draw(kind, seed, frames=40)
        found, scene = found_by(capture, sized=kind.sized, seed=seed)
        parts += [z for name, z in scores(capture, found, scene).items() if name != "radial"]
    errors = np.concatenate(parts)
    assert np.isfinite(errors).all()
    assert np.abs(errors).max() < 4.5
    assert 0.5 < np.sqrt(np.square(errors).mean()) < 1.7


def test_unlike_lenses_are_found_and_said_to_be_unlike() -> None:
    kind = Kind(3, alike=False)
    capture = draw(kind, 0, frames=40, noise=0.8)
    found, _ = found_by(capture, sized=True)
    focals = np.array([lens.focal for lens in capture.lenses])
    assert focals.max() > 2 * focals.min()
    np.testing.assert_allclose(found.rig.lenses.focals.mean(1), focals, rtol=0.04)
    assert "kinds" in found.reason or "unlike" in found.reason
