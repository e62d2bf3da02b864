"""Write files as detectors write them, of a computed capture: `python practice.py deeplabcut`.

Three cameras see a person or a mouse. What is written, and which mishap of real captures is in the
first take of it:

    deeplabcut  a mouse, a CSV file for each camera; cam3 began to film 6 frames late
    sleap       a mouse, an analysis file for each camera; cam2 has left and right swapped at times
    openpose    a person and somebody who stands by, as Pose2Sim lays files out
    npz         a person, one file

`--take 2` is what the same cameras filmed next, without the mishap. `--frames 300` is shorter.
`truth.npz` beside them has what is right: `fewview evaluate animation.npz truth.npz`.
"""

import argparse
import csv
import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from practice_subjects import Detections, Float64, Subject, detect, mouse, person

SEED = 4
LATE = 6  # frames that cam3 of DeepLabCut's files is late
SWAPPED = (60, 75)  # frames in which cam2 of SLEAP's files has left and right swapped
STANDS_BY = (-1.2, 0.0, 1.0)  # metres, where somebody stands in OpenPose's files
SCORER = "DLC_resnet50_open-fieldNov20shuffle1_500000"


def write_deeplabcut(subject: Subject, seen: list[Detections], folder: Path, take: int) -> None:
    """Write a table for each camera, with coordinates also where the likelihood is low."""
    heads = [("scorer", [SCORER] * 3), ("bodyparts", None), ("coords", ["x", "y", "likelihood"])]
    for number, view in enumerate(seen, start=1):
        first = LATE if number == 3 and take == 1 else 0
        with (folder / f"cam{number}{SCORER}.csv").open("w", newline="") as file:
            rows = csv.writer(file)
            for head, cells in heads:
                rows.writerow([head, *(w for name in subject.names for w in cells or [name] * 3)])
            for frame in range(len(subject.points) - first):
                found = np.c_[view.keypoints[frame + first], view.confidence[frame + first]]
                rows.writerow([frame, *np.round(found, 4).ravel().tolist()])


def write_sleap(subject: Subject, seen: list[Detections], folder: Path, take: int) -> None:
    """Write an analysis file for each camera, with nothing where a node was not found."""
    names = list(subject.names)
    other = [names.index(_other_side(name)) for name in names]
    for number, view in enumerate(seen, start=1):
        keypoints = np.where(view.hidden[..., None], np.nan, view.keypoints)
        scores = np.where(view.hidden, np.nan, view.confidence)
        if number == 2 and take == 1:
            frames = slice(*SWAPPED)
            keypoints[frames] = keypoints[frames][:, other]
        with h5py.File(folder / f"labels.v001.00{number - 1}_cam{number}.analysis.h5", "w") as file:
            file["tracks"] = keypoints.transpose(2, 1, 0)[None]  # (1, 2, nodes, frames)
            file["track_occupancy"] = np.ones((len(keypoints), 1), np.uint8)
            file["point_scores"] = scores.T[None]
            file["node_names"] = np.array(names, "S")
            file["track_names"] = np.array([], "S")
            file["edge_inds"] = [(names.index(a), names.index(b)) for a, b in subject.edges]


def write_openpose(subject: Subject, seen: list[Detections], folder: Path, take: int) -> None:
    """Write a file for each frame and camera, of two people in any order."""
    rng = np.random.default_rng(SEED)
    stands = subject.points[:1] - subject.points[:1, 8:9] * [1, 0, 1] + STANDS_BY
    sways = 0.01 * np.sin(np.arange(len(subject.points)) / 9)[:, None, None] * [1, 0, 0.5]
    for number, (camera, view) in enumerate(zip(subject.cameras, seen, strict=True), start=1):
        place = folder / "pose" / f"cam{number:02}_json"
        place.mkdir(parents=True)
        others = detect(camera.project(stands + sways), rng)
        for frame in range(len(subject.points)):
            people = [
                {"person_id": [-1], "pose_keypoints_2d": _flat(of, frame)}
                for of in ((view, others) if take == 1 else (view,))
            ]
            if rng.random() < 0.5:
                people.reverse()
            file = place / f"cam{number:02}_{frame:012}_keypoints.json"
            file.write_text(json.dumps({"version": 1.3, "people": people}))


def write_npz(subject: Subject, seen: list[Detections], folder: Path, _take: int) -> None:
    """Write one file for all cameras."""
    np.savez(
        folder / "capture.npz",
        keypoints=np.stack(
            [np.where(view.hidden[..., None], np.nan, view.keypoints) for view in seen], axis=1
        ).astype(np.float32),
        confidence=np.stack([view.confidence * ~view.hidden for view in seen], axis=1),
        fps=subject.fps,
        keypoint_names=subject.names,
        image_sizes=[camera.size for camera in subject.cameras],
    )


def _flat(view: Detections, frame: int) -> list[float]:
    """Return x, y, confidence of all keypoints of a frame; 0, 0, 0 of one that was not found."""
    found = np.c_[view.keypoints[frame], view.confidence[frame]] * ~view.hidden[frame][:, None]
    return [float(value) for value in np.round(found, 3).ravel()]


def _other_side(name: str) -> str:
    side, _, part = name.partition("_")
    return {"left": "right", "right": "left"}.get(side, side) + f"_{part}" * bool(part)


Write = Callable[[Subject, list[Detections], Path, int], None]
KINDS: dict[str, tuple[Callable[[int, int], Subject], Write]] = {
    "deeplabcut": (mouse, write_deeplabcut),
    "sleap": (mouse, write_sleap),
    "openpose": (person, write_openpose),
    "npz": (person, write_npz),
}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("folder", type=Path, nargs="?", default=Path(), help="default: this one")
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--take", type=int, default=1)
    arguments = parser.parse_args()
    subject_of, write = KINDS[arguments.kind]
    subject = subject_of(arguments.frames, (arguments.take - 1) * arguments.frames)
    rng = np.random.default_rng(SEED + arguments.take)
    seen = [detect(camera.project(subject.points), rng) for camera in subject.cameras]
    arguments.folder.mkdir(parents=True, exist_ok=True)
    write(subject, seen, arguments.folder, arguments.take)
    _write_truth(subject, arguments.folder / "truth.npz")


def _write_truth(subject: Subject, file: Path) -> None:
    points: Float64 = subject.points
    np.savez_compressed(file, points3d=points, keypoint_names=subject.names)


if __name__ == "__main__":
    main()
