"""How often a wrong calibration is found, in the right view.

Synthetic rigs with a given calibration, in which one view is bumped, zoomed, off its principal
point or exchanged for another camera: ``python -m benchmarks.given --cases 24``.
"""

import argparse
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.figures import console
from models.calibrating.result import SelfCalibration
from models.calibrating.self_calibration import self_calibrate, task_of
from models.numerics.steps import finished
from models.settings.config import FitConfig
from tests.models.rigs import FOCAL, IMAGE_SIZE, RigCapture, make_rig_capture

HARMS = ("bumped", "zoomed", "centre", "exchanged")
NOISES = (1, 3, 5)  # pixels
Calibration = list[dict[str, Any]]


def true_calibration(capture: RigCapture) -> Calibration:
    """Return lenses and poses of every view."""
    return [
        {
            "intrinsics": {"fx": FOCAL, "cx": 640.0, "cy": 512.0, "distortion": []},
            "rotation": rotation.tolist(),
            "translation": translation.tolist(),
        }
        for rotation, translation in zip(capture.rotations[0], capture.translations[0], strict=True)
    ]


def harmed(given: Calibration, view: int, harm: str, rng: np.random.Generator) -> Calibration:
    """Return a calibration that is wrong in one view."""
    camera = {**given[view], "intrinsics": dict(given[view]["intrinsics"])}
    sign = rng.choice([-1, 1])
    if harm == "bumped":
        axis = rng.standard_normal(3)
        turn = np.radians(rng.uniform(1, 10)) * axis / np.linalg.norm(axis)
        matrix = Rotation.from_rotvec(turn).as_matrix()
        for part in ("rotation", "translation"):
            camera[part] = (matrix @ np.array(camera[part])).tolist()
    elif harm == "zoomed":
        camera["intrinsics"]["fx"] *= 1 + sign * rng.uniform(0.1, 0.3)
    elif harm == "centre":
        camera["intrinsics"]["cx"] += sign * rng.uniform(40, 120)
    else:
        camera["intrinsics"] = {"fx": 1.3 * FOCAL, "cx": 500, "cy": 400, "distortion": [-0.2, 0.1]}
    return [*given[:view], camera, *given[view + 1 :]]


def calibrated(capture: RigCapture, given: Calibration) -> SelfCalibration:
    """Calibrate with this given calibration."""
    config = FitConfig.model_validate({"calibration": given})
    sizes = [IMAGE_SIZE] * len(given)
    steps = self_calibrate(
        task_of(capture.pixels, capture.weights, config, sizes), capture.answers()
    )
    return finished(steps)[0]


def named(found: SelfCalibration) -> list[int]:
    """Return the views with the finding `calibration_disagrees`."""
    disagreeing = [f for f in found.findings if f.code == "calibration_disagrees"]
    return sorted({view for finding in disagreeing for view in finding.views})


def main() -> None:
    """Plant faults, and print how many were found and how many right calibrations were doubted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=24, help="default: %(default)s")
    cases: int = parser.parse_args().cases
    right = doubted = 0
    for seed in range(cases):
        rng = np.random.default_rng(seed)
        views, harm = 3 + seed % 2, HARMS[seed % len(HARMS)]
        azimuths = np.linspace(0, 300, views, endpoint=False) + rng.uniform(-15, 15, views)
        noise = NOISES[seed % len(NOISES)]
        capture = make_rig_capture(azimuths.tolist(), frames=30, noise=noise, seed=seed)
        given, view = true_calibration(capture), int(rng.integers(views))
        found = named(calibrated(capture, harmed(given, view, harm, rng)))
        right += found == [view]
        doubted += named(calibrated(capture, given)) != []
        console.print(f"{views} views, {noise} px: {harm} {view}, found {found}", soft_wrap=True)
    console.print(f"{right} of {cases} named rightly; {doubted} right calibrations doubted")


if __name__ == "__main__":
    main()
