"""What a fit looks for depends on what is given of the cameras."""

from models.causes.cause import CODES
from models.settings.config import FitConfig
from models.training.trainer import fit
from tests.models.rigs import make_rig_capture

QUICK = FitConfig(steps=3, dictionary_sizes=(16, 8), batch_size=8, cameras="moving")


def test_moving_cameras_show_nothing_that_is_wrong_with_pixels() -> None:
    """Static ones would show it here."""
    keypoints = make_rig_capture([0, 100, 220], frames=40, noise=0.7, distance=2.5).keypoints
    keypoints[:, 1] = (keypoints[:, 1] + 0.5) / 2 - 0.5
    prior = fit(keypoints, QUICK)
    assert not {finding.code for finding in prior.findings} & {*CODES.values()}
