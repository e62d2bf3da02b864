"""A short GIF: the skeleton in the room beside its reprojections into the views."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fewview.animation import Animation
from fewview.calibration.camera import Camera
from fewview.errors import FormatError

Float64 = NDArray[np.float64]

MOST = 100  # frames of a GIF by default
MARGIN = 0.1  # of the keypoints' extent, about them in the views
SEEN, FOUND = "#d1495b", "#00798c"
# From the room's axes to those of the drawing, x right, y away, z up.
DRAWN = {
    "y": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "-y": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "z": np.eye(3),
}


def write_gif(
    path: str | PathLike[str],
    animation: Animation,
    keypoints: ArrayLike | None = None,
    cameras: Sequence[Camera] = (),
    *,
    up: Literal["y", "-y", "z"] = "y",
    frames: int = MOST,
) -> Path:
    """Write a GIF of an animation, with keypoints and reprojections in the cameras of its room.

    Parameters
    ----------
    animation
        N frames of P points; if there are more than `frames`, a regular part of them is drawn, at
        their own times.
    keypoints, cameras
        (N, K, P, 2) pixels, and the K cameras, in the room of the points. Views without a pose are
        left out. Keypoints are drawn as dots, reprojections as crosses and sticks.
    up
        The axis that points up: 'y' as from `to_room` if up is known, '-y' otherwise.

    Raises
    ------
    FormatError
        If matplotlib is not installed, or no point was ever seen.
    ValueError
        If keypoints and cameras do not fit the animation.
    """
    try:
        from matplotlib.animation import PillowWriter  # noqa: PLC0415  # an extra
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError as error:
        raise FormatError(
            "GIF needs matplotlib, which is not installed: pip install 'fewview[gif]'"
        ) from error
    views = [place for place, camera in enumerate(cameras) if camera.rotation is not None]
    count, points = animation.points.shape[:2]
    seen = np.asarray(keypoints, dtype=np.float64) if views else np.empty(0)
    if views and seen.shape != (count, len(cameras), points, 2):
        raise ValueError(f"expected keypoints {(count, len(cameras), points, 2)}, got {seen.shape}")
    if not animation.seen.any():
        raise FormatError("no point of the animation was ever seen")
    figure = Figure(figsize=(4 * (1 + len(views)), 4), layout="constrained")
    room = figure.add_subplot(1, 1 + len(views), 1, projection="3d")
    panels = [_Panel(room, animation.points @ DRAWN[up].T, animation.edges)]
    for column, view in enumerate(views, start=2):
        axes = figure.add_subplot(1, 1 + len(views), column, title=cameras[view].name)
        found = cameras[view].project(animation.points)
        panels.append(_Panel(axes, found, animation.edges, seen[:, view]))
    stride = -(-count // frames)
    writer = PillowWriter(fps=max(round(animation.rate / stride), 1))
    with writer.saving(figure, str(path), dpi=80):
        for frame in range(0, count, stride):
            for panel in panels:
                panel.draw(frame)
            writer.grab_frame()
    return Path(path)


class _Panel:
    """Points (N, P, 2 or 3) with their sticks in one place of the picture, and what was seen."""

    def __init__(
        self,
        axes: Any,
        points: Float64,
        edges: Sequence[tuple[int, int]],
        seen: Float64 | None = None,
    ) -> None:
        self.points, self.edges, self.seen = points, edges, seen
        width = points.shape[-1]
        everything = points if seen is None else np.concatenate((points, seen))
        low, high = (limit(everything, axis=(0, 1)) for limit in (np.nanmin, np.nanmax))
        margin = MARGIN * max((high - low).max(), 1e-9)
        low, high = low - margin, high + margin
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        if width == 3:
            axes.set(zlim=(low[2], high[2]), xticklabels=[], yticklabels=[], zticklabels=[])
            axes.set_box_aspect(high - low)
        else:
            axes.set(ylim=(high[1], low[1]), aspect="equal", xticks=[], yticks=[])
            (self.dots,) = axes.plot([], [], ".", color=SEEN, markersize=9)
        nothing: list[list[float]] = [[]] * width
        (self.marks,) = axes.plot(*nothing, "." if width == 3 else "x", color=FOUND, markersize=4)
        self.sticks = [axes.plot(*nothing, color=FOUND, linewidth=1.2)[0] for _ in edges]

    def draw(self, frame: int) -> None:
        """Show a frame."""
        points = self.points[frame]
        for line, places in (
            (self.marks, points),
            *(
                (stick, points[list(edge)])
                for stick, edge in zip(self.sticks, self.edges, strict=True)
            ),
        ):
            (line.set_data if places.shape[1] == 2 else line.set_data_3d)(*places.T)
        if self.seen is not None:
            self.dots.set_data(*self.seen[frame].T)
