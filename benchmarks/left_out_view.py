"""How well views predict a view that is left out, where there is no truth: real detections.

    python -m benchmarks.left_out_view CAPTURE.npz [--steps N] [--times]

Each view in turn is left out of every frame; the others are lifted, and the structure is projected
into it. The error is the distance to its keypoints. It is compared with robust triangulation of the
same keypoints with a given calibration: `cameras` (`K`, `R`, `t`, lenses without distortion) and
`image_sizes` in a CAPTURE.json next to CAPTURE.npz. One fit has no calibration, another has that
one. The cameras of a fit were estimated, or held, with all views; structures use only the others.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.captures import Capture, fields_beside, read_capture
from benchmarks.figures import print_table
from models.calibrating.result import CameraReport
from models.capture.triangulation import triangulate
from models.lifting.fitted_prior import FittedPrior
from models.settings.config import FitConfig
from models.training.trainer import fit

Float64 = NDArray[np.float64]

LEAST_CONFIDENCE = 0.3  # of a keypoint that is triangulated, or predicted
DROPPED = 1  # rays of a point that robust triangulation may leave out


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Predict views that are left out.")
    parser.add_argument("capture", type=Path, help=".npz; a .json beside it has its cameras")
    parser.add_argument("--steps", type=int, default=FitConfig().steps, help="default: %(default)s")
    parser.add_argument("--times", action="store_true", help="give the fit the times of the frames")
    arguments = parser.parse_args()
    capture, fields = read_capture(arguments.capture), fields_beside(arguments.capture)
    if "cameras" not in fields or "image_sizes" not in fields:
        raise SystemExit(f"{arguments.capture.stem}.json must have `cameras` and `image_sizes`")
    trusted: NDArray[np.bool_] = np.all(np.isfinite(capture.keypoints), -1)
    if capture.confidence is not None:
        trusted &= capture.confidence >= LEAST_CONFIDENCE
    distances = {"triangulation": by_triangulation(capture, fields, trusted)}
    seconds = None
    if arguments.times:
        seconds = np.arange(len(capture.keypoints)) / fields["fps"]
    for name, calibration in (
        ("no calibration", None),
        ("calibration given", as_calibration(fields)),
    ):
        config = FitConfig(steps=arguments.steps)
        if calibration is not None:
            config = FitConfig.model_validate(config.model_dump() | {"calibration": calibration})
        prior = fit(
            capture.keypoints,
            config,
            confidence=capture.confidence,
            times=seconds,
            image_sizes=[(int(width), int(height)) for width, height in fields["image_sizes"]],
            edges=capture.edges,
        )
        distances[f"fit, {name}"] = by_lifts(prior, capture, seconds)
    asked = trusted & np.all([np.isfinite(each) for each in distances.values()], axis=0)
    base = distances["triangulation"][asked]
    print_table(
        f"{arguments.capture.stem}: {asked.sum()} keypoints of views that were left out",
        [
            {
                "by": name,
                "median px": float(np.median(each[asked])),
                "mean px": float(each[asked].mean()),
                "median ratio": float(np.median(each[asked]) / np.median(base)),
                "mean ratio": float(each[asked].mean() / base.mean()),
            }
            for name, each in distances.items()
        ],
    )


def as_calibration(fields: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the calibration in the form of a fit's configuration."""
    return [
        {
            "intrinsics": {
                "fx": camera["K"][0][0],
                "fy": camera["K"][1][1],
                "cx": camera["K"][0][2],
                "cy": camera["K"][1][2],
                "distortion": [],
            },
            "rotation": camera["R"],
            "translation": np.ravel(camera["t"]).tolist(),
        }
        for camera in fields["cameras"]
    ]


def by_triangulation(
    capture: Capture, fields: dict[str, Any], trusted: NDArray[np.bool_]
) -> Float64:
    """Distances (N, K, P) in pixels to where the other views have keypoints; NaN where nowhere."""
    projections = np.stack(
        [
            np.array(camera["K"]) @ np.column_stack((camera["R"], np.ravel(camera["t"])))
            for camera in fields["cameras"]
        ]
    )
    shown = np.where(trusted[..., None], capture.keypoints, np.nan)
    distances = np.empty(trusted.shape)
    for view, projection in enumerate(projections):
        others = np.delete(np.arange(len(projections)), view)
        points = triangulate(shown[:, others], projections[others], rounds=DROPPED).points3d
        image = points @ projection[:, :3].T + projection[:, 3]
        off = image[..., :2] / image[..., 2:] - capture.keypoints[:, view]
        distances[:, view] = np.linalg.norm(off, axis=-1)
    return distances


def by_lifts(prior: FittedPrior, capture: Capture, times: Float64 | None) -> Float64:
    """Distances (N, K, P) in pixels to where lifts of the other views have keypoints."""
    cameras = prior.cameras
    if cameras is None or not cameras.static.all():
        raise SystemExit("cameras move: a view that is left out is nowhere to be predicted")
    views = capture.keypoints.shape[1]
    distances = np.empty(capture.keypoints.shape[:3])
    for view in range(views):
        others = [other for other in range(views) if other != view]
        confidence = None if capture.confidence is None else capture.confidence[:, others]
        lift = prior.lift(
            capture.keypoints[:, others], confidence=confidence, views=others, times=times
        )
        lifted = (lift.camera_models > 0).argmax(1)  # the first view with a camera
        frames, first = np.arange(len(lifted)), np.array(others)[lifted]
        camera = lift.points3d @ lift.rotations[frames, lifted].mT
        camera = camera + lift.translations[frames, lifted][:, None]
        room = (camera - cameras.translations[first][:, None]) @ cameras.rotations[first]
        pixels = projected(room, cameras, view)
        distances[:, view] = np.linalg.norm(pixels - capture.keypoints[:, view], axis=-1)
    return distances


def projected(points: Float64, cameras: CameraReport, view: int) -> Float64:
    """Pixels (N, P, 2) of points (N, P, 3) in a pinhole camera with radial distortion."""
    held = points @ cameras.rotations[view].T + cameras.translations[view]
    flat = held[..., :2] / held[..., 2:]
    squared = np.square(flat).sum(-1, keepdims=True)
    first, second = cameras.distortions[view, :2]
    bent = flat * (1 + first * squared + second * squared**2)
    return np.asarray(cameras.focals[view] * bent + cameras.principal_points[view], np.float64)


if __name__ == "__main__":
    main()
