"""Make ``three_actors.npz``, the capture that ``make demo`` runs on.

    python examples/make_capture.py SOURCE.npz [OUTPUT.npz]

The source holds real human motion, seen exactly by six cameras that were computed: ``keypoints``
(frames, 6, 31, 2) in pixels and ``points3d`` (frames, 31, 3) in metres. Here it is thinned out to
the frames and views of a small capture, and seen again through the eyes of a keypoint detector:
noisy, with gaps, and with a confidence that knows about as much of the error as a detector's does.

The same source always gives the same file, byte for byte. README.md says where the motion is from.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

SEED = 20
FRAMES = 800
VIEWS = (0, 2, 3)  # two near the floor, the third higher up on the other side
IMAGE_SIZE = (1280, 1024)

NOISE = 2.0  # pixels: scale of the error along x and y
TAILS = 4.0  # degrees of freedom of Student's t: the fewer, the more keypoints are far off
ASTRAY = 0.01  # share of keypoints that were mistaken for something nearby
ASTRAY_DISTANCE = (20.0, 60.0)  # pixels
HIDDEN = 0.02  # share of keypoints without a detection
HIDDEN_VIEW = 0.05  # share of views of a frame without any: the actor was not found
HARD = 1.8  # how much more often and farther hands and toes are missed than the others
PIXEL_STEP = 1 / 16  # keypoints are rounded to this, which halves the file

# The joints of the Acclaim skeleton that the source's forward kinematics gives, in its order.
KEYPOINT_NAMES = (
    *("root", "lhipjoint", "lfemur", "ltibia", "lfoot", "ltoes"),
    *("rhipjoint", "rfemur", "rtibia", "rfoot", "rtoes"),
    *("lowerback", "upperback", "thorax", "lowerneck", "upperneck", "head"),
    *("lclavicle", "lhumerus", "lradius", "lwrist", "lhand", "lfingers", "lthumb"),
    *("rclavicle", "rhumerus", "rradius", "rwrist", "rhand", "rfingers", "rthumb"),
)
PARENTS = (
    *(-1, 0, 1, 2, 3, 4),
    *(0, 6, 7, 8, 9),
    *(0, 11, 12, 13, 14, 15),
    *(13, 17, 18, 19, 20, 21, 20),
    *(13, 24, 25, 26, 27, 28, 27),
)
HARD_ENDINGS = ("toes", "hand", "fingers", "thumb")


class Detections(NamedTuple):
    """The detector's keypoints in N frames of K views."""

    keypoints: Float64  # (N, K, P, 2) pixels, NaN where it found nothing
    confidence: Float64  # (N, K, P) in [0, 1], 0 where it found nothing


def detect(exact: Float64, rng: np.random.Generator) -> Detections:
    """See the exact keypoints (N, K, P, 2) as a detector would."""
    shape = exact.shape[:3]
    hard = np.where([name.endswith(HARD_ENDINGS) for name in KEYPOINT_NAMES], HARD, 1.0)  # (P,)

    error = NOISE * hard[:, None] * rng.standard_t(TAILS, exact.shape)
    astray = rng.random(shape) < ASTRAY * hard
    angle = rng.uniform(0, 2 * np.pi, shape)
    jump = rng.uniform(*ASTRAY_DISTANCE, shape)[..., None]
    error += np.where(
        astray[..., None], jump * np.stack((np.cos(angle), np.sin(angle)), axis=-1), 0
    )
    keypoints = np.round((exact + error) / PIXEL_STEP) * PIXEL_STEP

    # A detector suspects most of its large errors, not their exact size.
    distance = np.linalg.norm(error, axis=-1)
    suspected = distance * np.exp(0.4 * rng.standard_normal(shape))
    confidence = np.clip(np.exp(-suspected / (8 * NOISE)), 0.05, 1)

    hidden = rng.random(shape) < HIDDEN * hard**2
    hidden |= (rng.random(shape[:2]) < HIDDEN_VIEW)[..., None]
    hidden |= ((keypoints < 0) | (keypoints >= IMAGE_SIZE)).any(-1)
    keypoints[hidden] = np.nan
    confidence[hidden] = 0
    return Detections(keypoints, np.round(confidence, 2))


def make_capture(source: Path, output: Path) -> None:
    """Read the exact capture, write the detected one."""
    with np.load(source, allow_pickle=False) as arrays:
        exact, points3d = arrays["keypoints"], arrays["points3d"]
    frames = np.linspace(0, len(exact) - 1, FRAMES).round().astype(int)  # all clips, evenly
    rng = np.random.default_rng(SEED)
    seen = detect(exact[frames][:, VIEWS].astype(np.float64), rng)
    np.savez_compressed(
        output,
        keypoints=seen.keypoints.astype(np.float32),
        confidence=seen.confidence.astype(np.float32),
        points3d=np.round(points3d[frames], 4).astype(np.float32),  # to a tenth of a millimetre
        keypoint_names=np.array(KEYPOINT_NAMES),
        edges=np.array([(parent, child) for child, parent in enumerate(PARENTS) if parent >= 0]),
        image_sizes=np.array([IMAGE_SIZE] * len(VIEWS)),
    )


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Make the demo's capture; README.md says more.")
    parser.add_argument("source", type=Path, help=".npz file of exact keypoints and points3d")
    parser.add_argument(
        "output",
        type=Path,
        nargs="?",
        default=Path(__file__).with_name("three_actors.npz"),
        help="default: %(default)s",
    )
    arguments = parser.parse_args()
    make_capture(arguments.source, arguments.output)


if __name__ == "__main__":
    main()
