"""Fits: jobs that turn a dataset into a model."""

import zipfile
from collections.abc import Callable, Iterable, Mapping
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from fewview.api.arrays import SAFETENSORS
from fewview.api.calibrations import Calibration, in_request_form
from fewview.api.forms import Cameras, Dataset, Fit, Model, form_in
from fewview.api.jobs import Jobs
from fewview.api.label_forms import FitLabels
from fewview.api.lifting import Lift, identifier, room_query
from fewview.api.operations import Driver, operation
from fewview.api.report_forms import FitReport
from fewview.api.schedule_forms import FitSchedule
from fewview.api.steps import Request, Steps, once, path
from fewview.api.stored import labels


class Fits(Jobs[Driver, Fit]):
    """``/fits``."""

    _form = Fit
    _plural = "fits"

    @operation
    def create(
        self,
        /,
        dataset: Dataset | str,
        *,
        name: str | None = None,
        from_model: Model | str | None = None,
        priority: str | None = None,
        calibration: Calibration | None = None,
        tags: Iterable[str] = (),
        metadata: Mapping[str, Any] | None = None,
        **config: Any,
    ) -> Steps[Fit]:
        """Queue a fit of a dataset.

        Parameters
        ----------
        from_model
            A model of the same keypoints from whose weights the fit starts.
        priority
            ``high``, ``normal`` or ``low``, among the fits of a project that wait.
        calibration
            Given cameras: a calibration file, whose cameras have the names of the dataset's views
            (:func:`fewview.calibration.for_views`) or else are in their order; or a list in the
            order of the views, of :class:`~fewview.calibration.Camera` or of objects as the API
            takes them, None where nothing is known. "dataset": those that came with the dataset.
        tags, metadata
            Words, and any JSON object, for finding the fit and its model.
        config
            Fields of ``FitConfig`` in the API: ``steps``, ``cameras``, ``known_length``,
            ``known_distance`` and more.

        Raises
        ------
        FormatError
            The calibration cannot be read, or its cameras do not fit the views.
        InvalidRequest
            The configuration is wrong, or does not fit this dataset; ``errors`` name the fields.
        TooManyRequests
            Too many fits wait.
        """
        if calibration is not None and calibration != "dataset":
            known = yield from in_request_form(self._call, calibration, identifier(dataset))
            config["calibration"] = known
        fields = labels(tags, metadata) | {
            "dataset_id": identifier(dataset),
            "name": name,
            "from_model": None if from_model is None else identifier(from_model),
            "priority": priority,
            "calibration": "dataset" if calibration == "dataset" else None,
            "config": config or None,
        }
        body = {key: value for key, value in fields.items() if value is not None}
        return (
            yield from self._call(
                Request("POST", "/fits", form_in(Fit), headers=once(), body={"json": body})
            )
        )

    @operation
    def wait_for_answer(
        self, fit: Fit | str, *, on_progress: Callable[[Fit], object] | None = None
    ) -> Steps[Fit]:
        """Wait until a fit has its first answer, else until it has succeeded; return it then.

        Where geometry finds static cameras, reconstruction, cameras and findings are there while
        the network is still taught: ``answer_stage`` is ``geometry``. Raises as `wait` does.
        """
        return self._wait(
            identifier(fit), on_progress, lambda found: found.answer_stage is not None
        )

    @operation
    def schedule(self, fit: Fit | str) -> Steps[FitSchedule]:
        """Return when a fit is expected to start and to end, as the queue is now."""
        return self._call(
            Request("GET", path("fits", identifier(fit), "schedule"), form_in(FitSchedule))
        )

    @operation
    def cameras(self, fit: Fit | str) -> Steps[Cameras]:
        """Return the cameras that a fit has estimated by now.

        Raises
        ------
        Conflict
            It has neither a first answer nor a model.
        """
        return self._call(
            Request("GET", path("fits", identifier(fit), "cameras"), form_in(Cameras))
        )

    @operation
    def reconstruction(
        self,
        fit: Fit | str,
        *,
        refine: str | None = None,
        frame: str | None = None,
        up: ArrayLike | None = None,
        uncertainty: str | None = None,
    ) -> Steps[Lift]:
        """Return all fitted frames in 3D.

        Parameters
        ----------
        refine
            ``auto``, ``full`` or ``off``: lift them again with this refinement.
        frame, up
            The frame of reference; see :meth:`~fewview.Client.lift`.
        uncertainty
            ``off``, ``sd`` or ``full``, for which the frames are lifted again. None: ``sd``.

        Raises
        ------
        Conflict
            The fit has no answer yet, or none of its cameras is static and there is no room.
        """
        where = path("fits", identifier(fit), "reconstruction")
        headers = {"Accept": SAFETENSORS}
        return self._call(
            Request(
                "GET",
                where,
                Lift.of,
                params={"refine": refine, "uncertainty": uncertainty, **room_query(frame, up)},
                headers=headers,
            )
        )

    @operation
    def report(self, fit: Fit | str) -> Steps[FitReport]:
        """Return what a fit may be relied on for, to how much, and what would help most.

        Raises
        ------
        Conflict
            The fit has not succeeded, or an older version made it.
        """
        where = path("fits", identifier(fit), "report")
        return self._call(
            Request("GET", where, form_in(FitReport), headers={"Accept": "application/json"})
        )

    @operation
    def report_page(self, fit: Fit | str) -> Steps[str]:
        """Return the report as a page of HTML, which needs nothing else; raises as `report`."""
        where = path("fits", identifier(fit), "report")
        return self._call(
            Request("GET", where, lambda found: found.text, params={"format": "html"})
        )

    @operation
    def labels(
        self, fit: Fit | str, *, limit: int | None = None, apart: int | None = None
    ) -> Steps[FitLabels]:
        """Return the images that would teach the detector most, if a human labelled them.

        Parameters
        ----------
        limit
            How many at most; None: 50.
        apart
            Frames between two images of a view for the same reason, at least; None: 15.

        Raises
        ------
        Conflict
            The fit has not succeeded.
        """
        where = path("fits", identifier(fit), "labels")
        query = {"limit": limit, "apart": apart}
        return self._call(Request("GET", where, form_in(FitLabels), params=query))

    @operation
    def download_labels(
        self, /, fit: Fit | str, folder: str | PathLike[str], format: str, **options: Any
    ) -> Steps[list[Path]]:
        """Write the keypoints that the fit accepts as labels of images; return the files.

        Parameters
        ----------
        format
            ``dlc``, ``dlc-machine``, ``coco`` or ``lightning-pose``.
        options
            Those of the API: ``source`` (``reprojections`` or ``keypoints``), ``images``
            (``worth-labelling`` or ``all``), ``most``, ``least_weight``, ``scorer``, ``apart``.

        Raises
        ------
        InvalidRequest
            No image has labels, or an option is wrong.
        """
        where = path("fits", identifier(fit), "labels", "file")
        content = yield from self._call(
            Request("GET", where, lambda found: found.content, params={"format": format, **options})
        )
        with zipfile.ZipFile(BytesIO(content)) as archive:
            return [Path(archive.extract(name, Path(folder))) for name in archive.namelist()]
