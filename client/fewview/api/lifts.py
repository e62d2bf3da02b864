"""Lifts: stored datasets of any length, lifted by all workers there are."""

from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from fewview.api.arrays import SAFETENSORS
from fewview.api.downloads import download
from fewview.api.forms import Dataset, LiftJob, Model, form_in
from fewview.api.jobs import Jobs
from fewview.api.lifting import Lift, identifier, up_in_json
from fewview.api.operations import Driver, operation
from fewview.api.steps import Request, Steps, once, path
from fewview.api.stored import labels

FORMATS = {".jsonl": "jsonl", ".ndjson": "jsonl", ".npz": "npz", ".safetensors": "safetensors"}


class Lifts(Jobs[Driver, LiftJob]):
    """``/lifts``."""

    _form = LiftJob
    _plural = "lifts"

    @operation
    def create(
        self,
        model: Model | str,
        dataset: Dataset | str,
        *,
        name: str | None = None,
        refine: str | None = None,
        views: Iterable[int] | None = None,
        frame: str | None = None,
        up: ArrayLike | None = None,
        uncertainty: str | None = None,
        tags: Iterable[str] = (),
        metadata: Mapping[str, Any] | None = None,
    ) -> Steps[LiftJob]:
        """Queue the lift of a dataset.

        Parameters
        ----------
        refine
            ``auto``, ``full`` or ``off``: where frames are refined. None: as in the fit.
        views
            Which views of the fit the dataset's are; None if they are all, or unknown.
        frame, up
            The frame of reference of the result; see :meth:`~fewview.Client.lift`.
        uncertainty
            ``off``, ``sd`` or ``full``: how much of it the result has. None: ``sd``.
        tags, metadata
            Words, and any JSON object, for finding the lift.

        Raises
        ------
        Conflict
            The model has no room, because none of its cameras is static.
        InvalidRequest
            The dataset has other keypoints than the model, or there are no such views.
        TooManyRequests
            Too many lifts wait.
        """
        fields = labels(tags, metadata) | {
            "model_id": identifier(model),
            "dataset_id": identifier(dataset),
            "name": name,
            "refine": refine,
            "views": None if views is None else list(views),
            "frame": frame,
            "up": None if up is None else up_in_json(up),
            "uncertainty": uncertainty,
        }
        body = {key: value for key, value in fields.items() if value is not None}
        return self._call(
            Request("POST", "/lifts", form_in(LiftJob), headers=once(), body={"json": body})
        )

    @operation
    def result(self, lift: LiftJob | str) -> Steps[Lift]:
        """Return all frames in 3D, in memory.

        Raises
        ------
        Conflict
            The lift has not succeeded.
        """
        where = path("lifts", identifier(lift), "result")
        return self._call(Request("GET", where, Lift.of, headers={"Accept": SAFETENSORS}))

    @operation
    def download(
        self, lift: LiftJob | str, file: str | PathLike[str], *, format: str | None = None
    ) -> Steps[Path]:
        """Download all frames into a file; what broke off goes on where it was.

        Parameters
        ----------
        format
            ``jsonl``, ``npz`` or ``safetensors``; None: by the file's ending.

        Raises
        ------
        Conflict
            The lift has not succeeded.
        ValueError
            The ending is of another format.
        """
        file = Path(file)
        format = format or FORMATS.get(file.suffix.lower())
        if format is None:
            raise ValueError(f"expected a file ending in {', '.join(FORMATS)}, got {file.name!r}")
        where = path("lifts", identifier(lift), "result")
        return download(where, file, self._patience, format=format)
