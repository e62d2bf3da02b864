"""Drawing lifted structures beside their truth."""

from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

Array = NDArray[np.float64]

GREY = "#b8b8b8"
MARGIN = 1.08


class Scene(NamedTuple):
    """One frame, as one of its cameras sees it."""

    title: str
    image: Array  # (P, 2) pixels: what the camera saw, NaN where nothing
    structure: Array  # (P, 3) camera axes: x right, y down, z forward
    truth: Array | None  # (P, 3) likewise, moved onto the structure


def draw(path: Path, scenes: list[Scene], edges: list[tuple[int, int]], caption: str) -> None:
    """Draw a row per scene: the image, then the structure from the front and from the side.

    Where the truth is known, it stands beside the structure, and in grey behind it.
    """
    with_truth = any(scene.truth is not None for scene in scenes)
    columns = 5 if with_truth else 3
    figure = Figure(figsize=(3 * columns, 3.1 * len(scenes) + 0.8), layout="constrained")
    axes = figure.subplots(len(scenes), columns, squeeze=False)
    for row, scene in zip(axes, scenes, strict=True):
        _draw_scene(row, scene, edges)
    titles = ["keypoints in one view", "lifted, from that view", "lifted, from its right"]
    if with_truth:
        titles = [*titles[:2], "truth, from that view", titles[2], "truth, from its right"]
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=11)
    figure.suptitle(caption, fontsize=12)
    figure.savefig(path, dpi=110)


def _draw_scene(row: NDArray[np.object_], scene: Scene, edges: list[tuple[int, int]]) -> None:
    image, *panels = row
    _draw_points(image, scene.image, edges)
    _frame(image, scene.image)
    image.set_ylabel(scene.title, fontsize=10)
    everything = (
        scene.structure if scene.truth is None else np.concatenate((scene.structure, scene.truth))
    )
    for flatten in (_front, _side):
        axis = panels.pop(0)
        if scene.truth is not None:
            _draw_points(axis, flatten(scene.truth), edges, color=GREY)
        _draw_points(axis, flatten(scene.structure), edges)
        _frame(axis, flatten(everything))
        if scene.truth is not None:
            axis = panels.pop(0)
            _draw_points(axis, flatten(scene.truth), edges)
            _frame(axis, flatten(everything))
    for axis in panels:  # this one frame has no truth
        axis.set_axis_off()


def _front(points: Array) -> Array:
    return points[:, :2]


def _side(points: Array) -> Array:
    """Look along the camera's x axis, from its right: what is far away lies to the right."""
    return points[:, [2, 1]]


def _draw_points(
    axis: Axes, points: Array, edges: list[tuple[int, int]], *, color: str | None = None
) -> None:
    """Draw points (P, 2) in colours that go with their numbers, and the lines between them."""
    colors = mpl.colormaps["turbo"](np.linspace(0.05, 0.95, len(points)))
    for a, b in edges:
        axis.plot(*points[[a, b]].T, color=color or colors[b], linewidth=2, zorder=1)
    size = 12 if edges else 28
    axis.scatter(
        points[:, 0],
        points[:, 1],
        c=colors if color is None else color,
        s=size,
        linewidths=0,
        zorder=2,
    )


def _frame(axis: Axes, points: Array) -> None:
    """Show a square about the points, y down as in the image."""
    known = points[np.isfinite(points).all(-1)]
    low, high = known.min(0), known.max(0)
    half = max(MARGIN / 2 * (high - low).max(), 1e-6)
    x, y = (low + high) / 2
    axis.set(xlim=(x - half, x + half), ylim=(y + half, y - half), aspect="equal")
    axis.set(xticks=[], yticks=[])
    for spine in axis.spines.values():
        spine.set_color("#dddddd")
