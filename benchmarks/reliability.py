"""A picture of how often the truth is as near as it should be: nominal against observed shares."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

GREY = "#808080"  # legible on white and on dark grey
COLOURS = ("#d1495b", "#1b98ae")
SLACK = 0.06  # of the nominal share, that is shaded


class Curve(NamedTuple):
    """Observed shares of one half of the draws."""

    label: str
    panel: str  # what is counted
    observed: Float64  # for each level


def draw_reliability(levels: Sequence[float], curves: Sequence[Curve], path: Path) -> None:
    """Draw a panel for each thing that is counted, as an SVG without background."""
    panels = list(dict.fromkeys(curve.panel for curve in curves))
    with mpl.rc_context(
        {
            "text.color": GREY,
            "axes.labelcolor": GREY,
            "axes.edgecolor": GREY,
            "xtick.color": GREY,
            "ytick.color": GREY,
            "svg.fonttype": "none",
            "svg.hashsalt": path.name,
        }
    ):
        figure = Figure(figsize=(9, 4.4), layout="constrained")
        for axes, panel in zip(
            figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
        ):
            _draw_panel(axes, panel, levels, [curve for curve in curves if curve.panel == panel])
        figure.savefig(path, format="svg", transparent=True, metadata={"Date": None})


def _draw_panel(axes: Axes, panel: str, levels: Sequence[float], curves: Sequence[Curve]) -> None:
    nominal = 100 * np.array([0.0, *levels, 1.0])
    ends = np.array([0.0, 100.0])
    axes.fill_between(ends, ends - 100 * SLACK, ends + 100 * SLACK, color=GREY, alpha=0.2, lw=0)
    axes.plot(ends, ends, color=GREY, lw=0.8)
    for curve, colour in zip(curves, COLOURS, strict=False):
        observed = 100 * np.array([0.0, *curve.observed, 1.0])
        axes.plot(nominal, observed, "o-", markersize=3, color=colour, label=curve.label)
    axes.set(title=panel, xlabel="nominal, %", ylabel="observed, %", xlim=(0, 100), ylim=(0, 100))
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=9, frameon=False, loc="upper left")
