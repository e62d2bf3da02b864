"""The progress of a fit on a terminal, on stderr."""

from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from fewview.plain import visible

if TYPE_CHECKING:
    from fewview.api.forms import Fit


class FitProgressBar:
    """Shows how far a fit has come, in a ``with``; ``quiet`` shows nothing."""

    def __init__(self, *, quiet: bool = False) -> None:
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[figures]}"),
            console=Console(stderr=True),
            disable=quiet,
        )
        self._task = self._bar.add_task("queued", total=None, figures="")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _k: type[BaseException] | None, _e: BaseException | None, _t: TracebackType | None
    ) -> None:
        if self._bar.live.is_started:
            self._bar.stop()

    def show(self, fit: "Fit") -> None:
        """Show a fit as it is now; nothing of one that had ended before."""
        if fit.ended and not self._bar.live.is_started:
            return
        self._bar.start()  # with the first fit there is to show
        progress = fit.progress
        if progress is None:
            self._bar.update(self._task, description=visible(fit.status))
            return
        figures = []
        if progress.reprojection_error is not None:
            figures.append(f"{progress.reprojection_error:.1f} px")
        if progress.seconds_left and not fit.ended:
            figures.append(f"{progress.seconds_left:.0f} s left")
        self._bar.update(
            self._task,
            description=visible(fit.status if fit.ended else progress.stage),
            completed=progress.step,
            total=progress.steps,
            figures=", ".join(figures),
        )
