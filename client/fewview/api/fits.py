"""Fits: jobs that turn a dataset into a model."""

from collections.abc import Iterable, Mapping
from typing import Any

from numpy.typing import ArrayLike

from fewview.api.arrays import SAFETENSORS
from fewview.api.calibrations import Calibration, told
from fewview.api.forms import Dataset, Fit, Model, form_in
from fewview.api.jobs import Jobs
from fewview.api.lifting import Lift, identifier, room_query
from fewview.api.operations import Driver, operation
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
        calibration: Calibration | None = None,
        tags: Iterable[str] = (),
        metadata: Mapping[str, Any] | None = None,
        **config: Any,
    ) -> Steps[Fit]:
        """Queue a fit of a dataset.

        Parameters
        ----------
        from_model
            A model of the same keypoints whose weights are the first ones.
        calibration
            What is known of the cameras: a calibration file, whose cameras are those with the
            names of the dataset's views (:func:`fewview.calibration.for_views`), or else in their
            order; or a list in the order of the views, of
            :class:`~fewview.calibration.Camera` and of what the API takes, None where nothing is
            known.
        tags, metadata
            Words, and anything that is JSON, to find the fit and its model by.
        config
            Fields of ``FitConfig`` in the API: ``steps``, ``cameras``, ``known_length`` and more.

        Raises
        ------
        FormatError
            The calibration cannot be read, or its cameras do not fit the views.
        InvalidRequest
            The configuration is wrong, or not one for this dataset; ``errors`` say where.
        TooManyRequests
            Too many fits wait.
        """
        if calibration is not None:
            known = yield from told(self._call, calibration, identifier(dataset))
            config["calibration"] = known
        said = labels(tags, metadata) | {
            "dataset_id": identifier(dataset),
            "name": name,
            "from_model": None if from_model is None else identifier(from_model),
            "config": config or None,
        }
        body = {key: value for key, value in said.items() if value is not None}
        return (
            yield from self._call(
                Request("POST", "/fits", form_in(Fit), headers=once(), body={"json": body})
            )
        )

    @operation
    def reconstruction(
        self,
        fit: Fit | str,
        *,
        refine: str | None = None,
        frame: str | None = None,
        up: ArrayLike | None = None,
    ) -> Steps[Lift]:
        """Return all fitted frames in 3D.

        Parameters
        ----------
        refine
            ``auto``, ``full`` or ``off``: have them lifted anew, refined so.
        frame, up
            The frame of reference; see :meth:`~fewview.Client.lift`.

        Raises
        ------
        Conflict
            The fit has not succeeded, or none of its cameras rest and there is no room.
        """
        where = path("fits", identifier(fit), "reconstruction")
        headers = {"Accept": SAFETENSORS}
        return self._call(
            Request(
                "GET",
                where,
                Lift.of,
                params={"refine": refine, **room_query(frame, up)},
                headers=headers,
            )
        )
