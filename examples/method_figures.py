"""Draw the figures of docs/method.md: `python examples/method_figures.py`.

A person who walks is computed (`practice_subjects.py`), seen by three cameras with more and more
noise, and fitted with a service of its own. Takes ten minutes. Writes `docs/pictures/`.
"""

from pathlib import Path
from typing import Any

import numpy as np
from fewview import Client, Lift
from fewview.capture import Capture
from fewview.embedded import running_service
from fewview.evaluation import evaluate
from fewview.readers.skeletons import SKELETONS
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from practice_subjects import Camera, Float64, Subject, detect, person

from models.capture.triangulation import triangulate

PICTURES = Path(__file__).resolve().parents[1] / "docs" / "pictures"
FRAMES = 300
NOISE = (0.5, 1.0, 2.0, 4.0, 8.0)  # pixels, of a person some 350 high
SHOWN = 1.0  # the noise of the capture that is drawn
ERRORS = (2, 5, 10, 20, 50)  # millimetres, of the ticks
EVERY, FRAME = 45, 90  # of the structures in the room; of the keypoints in the views
EDGES = SKELETONS["body-25"].edges
SEEN, FOUND, TRUE = "#d1495b", "#00798c", "#b8b8b8"


def main() -> None:
    """Fit, measure, draw."""
    subject = person(FRAMES)
    rows = []
    with running_service() as address, Client(address) as client:
        for noise in NOISE:
            seen = captured(subject, noise)
            exact = triangulate(seen.keypoints, projections(subject.cameras)).points3d
            lifts = [lifted(client, seen, fps=fps) for fps in (None, subject.fps)]
            found = [lift.points3d.astype(np.float64) for lift in lifts]
            errors = [error(points, subject) for points in (*found, exact)]
            rows.append(errors)
            print(noise, *(f"{1000 * value:.1f} mm" for value in errors))
            if noise == SHOWN:
                draw_frame(subject, seen, lifts[-1])
    draw_noise(1000 * np.array(rows))


def captured(subject: Subject, noise: float) -> Capture:
    """Return what a detector makes of the subject; what it did not see is a gap."""
    rng = np.random.default_rng(1)
    seen = [detect(camera.project(subject.points), rng, noise=noise) for camera in subject.cameras]
    keypoints = [np.where(view.hidden[..., None], np.nan, view.keypoints) for view in seen]
    return Capture(
        np.stack(keypoints, axis=1).astype(np.float32),
        keypoint_names=subject.names,
        image_sizes=tuple(camera.size for camera in subject.cameras),
    )


def lifted(client: Client, seen: Capture, *, fps: float | None) -> Lift:
    """Fit a capture; return its frames in the room of the cameras."""
    rate: dict[str, Any] = {} if fps is None else {"fps": fps}
    fit = client.fits.wait(client.fits.create(client.datasets.create(seen, **rate)))
    return client.fits.reconstruction(fit, frame="room")


def error(points: Float64, subject: Subject) -> float:
    """Return the mean error in metres, all frames aligned together."""
    return evaluate(points, subject.points).mpjpe


def projections(cameras: tuple[Camera, ...]) -> Float64:
    """Return what projects points of the room to pixels, (K, 3, 4)."""
    found = []
    for camera in cameras:
        rotation, translation = camera.pose()
        lens = np.diag([camera.focal, camera.focal, 1.0])
        lens[:2, 2] = np.divide(camera.size, 2)
        found.append(lens @ np.c_[rotation, translation])
    return np.array(found)


def draw_noise(errors: Float64) -> None:
    """Draw errors (noise, methods) in millimetres."""
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    for column, (title, colour, style) in enumerate(
        (
            ("Fewview, frames in no order", FOUND, "o--"),
            ("Fewview, with the frame rate", FOUND, "o-"),
            ("triangulation with the true cameras", SEEN, "s-"),
        )
    ):
        axes.plot(NOISE, errors[:, column], style, color=colour, label=title)
    axes.set(
        xscale="log", yscale="log", xlabel="noise of the keypoints, px", ylabel="mean error, mm"
    )
    axes.set_xticks(NOISE, [f"{noise:g}" for noise in NOISE])
    axes.set_yticks(ERRORS, [f"{value:g}" for value in ERRORS])
    axes.minorticks_off()
    axes.grid(alpha=0.25)
    axes.legend()
    figure.savefig(PICTURES / "method-noise.png", dpi=110)


def draw_frame(subject: Subject, seen: Capture, lift: Lift) -> None:
    """Draw what goes into a fit, and what comes out of it."""
    figure = Figure(figsize=(11, 3.4), layout="constrained")
    panels = figure.subplots(1, 4, width_ratios=(1, 1, 1, 1.6))
    for view, axes in enumerate(panels[:3]):
        pixels = seen.keypoints[FRAME, view]
        axes.plot(*pixels.T, ".", color=SEEN)
        middle = np.nanmean(pixels, axis=0)
        axes.set(title=f"in: keypoints of view {view}", xticks=[], yticks=[], aspect="equal")
        axes.set(xlim=(middle[0] - 230, middle[0] + 230), ylim=(middle[1] + 260, middle[1] - 260))
    panels[3].remove()
    room: Any = figure.add_subplot(1, 4, 4, projection="3d")
    room.set_title("out: cameras and structures")
    placed = aligned(lift, subject)
    for points in placed.points[::EVERY]:
        draw_body(room, points)
    for found, camera in zip(placed.centres, subject.cameras, strict=True):
        room.plot(*on_floor(np.array(camera.place)), "s", color=TRUE, markersize=11)
        room.plot(*on_floor(found), "s", color=FOUND, markersize=6)
    room.set_box_aspect((4, 4, 1.4))
    room.tick_params(labelsize=6)
    figure.savefig(PICTURES / "method-frame.png", dpi=110)


class Placed:
    """Structures and the centres of cameras, in the room of the truth."""

    def __init__(self, points: Float64, centres: Float64) -> None:
        self.points, self.centres = points, centres


def aligned(lift: Lift, subject: Subject) -> Placed:
    """Return structures (N, P, 3) and centres (K, 3), moved by one similarity (Umeyama, 1991)."""
    points = np.asarray(lift.points3d, np.float64)
    known = np.isfinite(points).all(-1)
    x, y = points[known], subject.points[known]
    u, sizes, v = np.linalg.svd((x - x.mean(0)).T @ (y - y.mean(0)))
    hand = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    rotation = u @ hand @ v
    scale = (sizes * np.diag(hand)).sum() / ((x - x.mean(0)) ** 2).sum()
    centres = -np.einsum("kji,kj->ki", lift.rotations[FRAME], lift.translations[FRAME])

    def move(values: Float64) -> Float64:
        return np.asarray(scale * (values - x.mean(0)) @ rotation + y.mean(0))

    return Placed(move(points), move(centres))


def draw_body(axes: Axes, points: Float64) -> None:
    """Draw a structure as sticks."""
    for edge in EDGES:
        axes.plot(*on_floor(points[list(edge)]), color=FOUND, linewidth=1)


def on_floor(points: Float64) -> Float64:
    """Return points (..., 3) in matplotlib's axes, (3, ...): z up, and no mirror image."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.array((x, -z, y))


if __name__ == "__main__":
    main()
