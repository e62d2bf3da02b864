"""After compiling ahead, no fit and no lift compiles anything more."""

import subprocess
import sys

# Signatures are counted in a process of their own: other tests compile for other arguments.
SCRIPT = """
import sys
import numpy as np
from numba.core.caching import FunctionCache
from models.capture.synthetic import synthetic_capture
from models.lifting.fitted_prior import FittedPrior
from models.settings.calibration import KnownLength
from models.settings.config import FitConfig
from models.training.precompile import compile_all, noisy_film_at_rest
from models.training.trainer import Trainer, fit

def signatures():
    found = set()
    for name, module in list(sys.modules.items()):
        if name.startswith("models."):
            for function in vars(module).values():
                if isinstance(getattr(function, "_cache", None), FunctionCache):
                    name = function.py_func.__module__ + "." + function.py_func.__qualname__
                    found |= {f"{name}{signature}" for signature in function.signatures}
    return found

compile_all()
before = signatures()
assert before
capture = synthetic_capture(frames=60, views=3, noise=2, hidden_views=0.1, seed=2)
more = {"early_stopping": True, "known_length": KnownLength(keypoints=(0, 1), length=0.3)}
for refine, cameras in (("auto", "auto"), ("full", "moving"), ("off", "auto")):
    config = FitConfig(steps=40, batch_size=32, refine=refine, cameras=cameras, **more)
    trainer = Trainer(capture.keypoints, config, image_sizes=[(1280, 1024)] * 3)
    for progress in trainer.run():
        if progress.step == 33:
            break
    trainer = Trainer(
        capture.keypoints, config, image_sizes=[(1280, 1024)] * 3, checkpoint=trainer.checkpoint()
    )
    for progress in trainer.run():
        pass
    prior = FittedPrior.from_bytes(trainer.result().to_bytes())
    for mode in ("auto", "full", "off"):
        lift = prior.lift(capture.keypoints, refine=mode)
        prior.lift(capture.keypoints[:1], previous=lift.frames(slice(1)), refine=mode)
        prior.lift(capture.keypoints[::-1, ::2], views=(0, 2), refine=mode)
        prior.lift(capture.keypoints.astype(np.float64)[:, :1], refine=mode)
fit(capture.keypoints[:, :1], FitConfig(steps=4))
noisy = noisy_film_at_rest()[::-1]
told = FitConfig(steps=40, batch_size=32, cameras="static")
times = np.arange(len(noisy)) / 30
for taken in (None, times):
    prior = fit(noisy, told, edges=[[0, 1], [1, 2]], times=taken)
    assert "noise were removed" in prior.cameras.reason
    prior.lift(noisy[:1])
prior.lift(noisy, times=times)
hidden = capture.keypoints.copy()
hidden[:, :, 5] = np.nan
prior = fit(hidden, FitConfig(steps=4, cameras="moving"))
prior.lift(hidden, previous=prior.lift(hidden))
limbs = [1, 2, 4, 5, 10, 11, 13, 14]
swapped = synthetic_capture(frames=200, views=3, noise=1, seed=4).keypoints
swapped[::8, 0][:, limbs] = swapped[::8, 0][:, [4, 5, 1, 2, 13, 14, 10, 11]]
prior = fit(swapped, FitConfig(steps=4, cameras="moving"))
assert any(finding.code == "left_right_mended" for finding in prior.findings)
prior.lift(swapped)
fit(synthetic_capture(frames=30, views=2, noise=5, seed=3).keypoints[:, :, :5], FitConfig(steps=4))
print("\\n".join(sorted(signatures() - before)))
"""


def test_a_fit_and_its_lifts_need_nothing_that_was_not_compiled_ahead() -> None:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", SCRIPT],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == ""
