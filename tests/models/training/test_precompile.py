"""After compiling ahead, no fit and no lift compiles anything more."""

import json
import multiprocessing
import subprocess
from collections.abc import Callable

import numpy as np
import pytest

from models.capture.synthetic import synthetic_capture
from models.lifting.fit_report import fit_report
from models.lifting.fitted_prior import FittedPrior
from models.numerics.compiled import signatures
from models.numerics.threads import use_threads
from models.settings.calibration import Camera, Intrinsics, KnownLength
from models.settings.config import Arrangement, FitConfig, Refine
from models.training.precompile import FOCAL, PROCESSES, compile_all, static_noisy_film
from models.training.trainer import Trainer, fit
from tests.sharing import made_once
from worker.process import python

# A fit that compiles is slow, and right. Of lifts, tests of priors see that they compile nothing.
pytestmark = pytest.mark.thorough

MODES: tuple[Refine, ...] = ("auto", "full", "off")
# Run in one process, which imports torch and Numba once and forks one more for each part. It is
# started from nothing: what tests fork otherwise has everything as machine code.
COMPILED = """
import json
import tests.models.training.test_precompile as parts
print(json.dumps(parts.compiled()))
"""


def fit_resume_and_lift(refine: Refine, cameras: Arrangement) -> None:
    capture = synthetic_capture(frames=60, views=3, noise=2, hidden_views=0.1, seed=2)
    length = KnownLength(keypoints=(0, 1), length=0.3)
    config = FitConfig(
        steps=40,
        batch_size=32,
        refine=refine,
        cameras=cameras,
        early_stopping=True,
        known_length=length,
    )
    sizes = [(1280, 1024)] * 3
    trainer = Trainer(capture.keypoints, config, image_sizes=sizes)
    for progress in trainer.run():
        if progress.step == 33:
            break
    trainer = Trainer(capture.keypoints, config, image_sizes=sizes, checkpoint=trainer.checkpoint())
    for _ in trainer.run():
        pass
    prior = FittedPrior.from_bytes(trainer.result().to_bytes())
    for mode in MODES:
        lift = prior.lift(capture.keypoints, refine=mode)
        prior.lift(capture.keypoints[:1], previous=lift.frames(slice(1)), refine=mode)
        prior.lift(capture.keypoints[::-1, ::2], views=(0, 2), refine=mode)
        prior.lift(capture.keypoints.astype(np.float64)[:, :1], refine=mode)


def fit_noisy_film(*, timed: bool) -> None:
    noisy = static_noisy_film()[::-1]
    # Once the lenses are looked for, which takes seconds, and once they are given.
    lenses = (Camera(intrinsics=Intrinsics(fx=FOCAL)),) * 2 if timed else None
    config = FitConfig(steps=40, batch_size=32, cameras="static", calibration=lenses)
    times = np.arange(len(noisy)) / 30 if timed else None
    prior = fit(noisy, config, edges=[[0, 1], [1, 2]], times=times)
    assert prior.cameras is not None
    assert "noise were removed" in prior.cameras.reason
    prior.lift(noisy[:1])
    fit_report(prior, prior.lift(noisy, uncertainty="full"), noisy)
    if timed:
        prior.lift(noisy, times=times)


def fit_odd_captures() -> None:
    capture = synthetic_capture(frames=60, views=3, noise=2, hidden_views=0.1, seed=2)
    fit(capture.keypoints[:, :1], FitConfig(steps=4))
    capture.keypoints[:, :, 5] = np.nan
    prior = fit(capture.keypoints, FitConfig(steps=4, cameras="moving"))
    prior.lift(capture.keypoints, previous=prior.lift(capture.keypoints))
    limbs = [1, 2, 4, 5, 10, 11, 13, 14]
    swapped = synthetic_capture(frames=200, views=3, noise=1, seed=4).keypoints
    swapped[::8, 0][:, limbs] = swapped[::8, 0][:, [4, 5, 1, 2, 13, 14, 10, 11]]
    prior = fit(swapped, FitConfig(steps=4, refine="off"))
    assert any(finding.code == "left_right_mended" for finding in prior.findings)
    prior.lift(swapped)
    few = synthetic_capture(frames=30, views=2, noise=5, seed=3).keypoints[:, :, :5]
    fit(few, FitConfig(steps=4))


PARTS: dict[str, Callable[[], None]] = {
    "refined where it helps": lambda: fit_resume_and_lift("auto", "auto"),
    "always refined": lambda: fit_resume_and_lift("full", "moving"),
    "never refined": lambda: fit_resume_and_lift("off", "auto"),
    "a noisy film": lambda: fit_noisy_film(timed=False),
    "a noisy film with times": lambda: fit_noisy_film(timed=True),
    "odd captures": fit_odd_captures,
}


def compiled() -> dict[str, list[str]]:
    """Return the functions that are machine code after each part, and after compiling ahead."""
    ahead = sorted(compile_all())
    with multiprocessing.get_context("fork").Pool(PROCESSES, maxtasksperchild=1) as pool:
        needed = pool.map(needed_by, PARTS, chunksize=1)
    return {"ahead": ahead, **dict(zip(PARTS, needed, strict=True))}


def needed_by(part: str) -> list[str]:
    """Return the functions that are machine code in a process that did nothing but a part."""
    use_threads(1)
    assert not signatures()
    PARTS[part]()
    return sorted(signatures())


@pytest.fixture(scope="module")
def functions(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    def compiled_elsewhere() -> bytes:
        command = python("-W", "ignore", "-c", COMPILED)
        return subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout

    found: dict[str, list[str]] = json.loads(
        made_once(tmp_path_factory, "compiled.json", compiled_elsewhere)
    )
    return found


@pytest.mark.parametrize("part", PARTS)
def test_fits_and_lifts_need_nothing_that_was_not_compiled_ahead(
    part: str, functions: dict[str, list[str]]
) -> None:
    assert functions[part]
    assert set(functions[part]) <= set(functions["ahead"])
