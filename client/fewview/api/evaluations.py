"""Evaluations: structures and cameras against a truth, computed by the service."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fewview.api.calibrations import Calibration, in_request_form
from fewview.api.forms import Dataset, Fit, form_in
from fewview.api.lifting import identifier
from fewview.api.operations import Driver, Resource, operation
from fewview.api.steps import Request, Steps, path


class Evaluations(Resource[Driver]):
    """``/evaluations``; :mod:`fewview.evaluation` computes the same without a service."""

    @operation
    def create(
        self,
        /,
        fit: Fit | str | None = None,
        *,
        points: ArrayLike | None = None,
        dataset: Dataset | str | None = None,
        truth: ArrayLike | None = None,
        calibration: Calibration | None = None,
        frame: str | None = None,
        reach: float | None = None,
        mirrored_too: bool = False,
        triangulate: str | None = None,
    ) -> Steps[dict[str, Any]]:
        """Measure a fit's structures, or others, and return the figures as the API names them.

        Parameters
        ----------
        points, truth
            (N, P, 3), NaN where not known.
        dataset
            One with a ground truth; None: that of the fit.
        calibration
            True cameras of the fit's views: a file or a list, as :meth:`Fits.create` takes it.
        frame, reach, mirrored_too, triangulate
            As in the API.

        Raises
        ------
        InvalidRequest
            These cannot be compared; ``errors`` have the reasons.
        """
        if calibration is not None and fit is not None:
            of = yield from self._call(Request("GET", path("fits", identifier(fit)), form_in(Fit)))
            calibration = yield from in_request_form(self._call, calibration, of.dataset_id)
        fields = {
            "fit_id": None if fit is None else identifier(fit),
            "dataset_id": None if dataset is None else identifier(dataset),
            "points": None if points is None else _listed(points),
            "truth": None if truth is None else _listed(truth),
            "calibration": calibration,
            "frame": frame,
            "reach": reach,
            "mirrored_too": mirrored_too,
            "triangulate": triangulate,
        }
        body = {key: value for key, value in fields.items() if value is not None}
        return (
            yield from self._call(
                Request(
                    "POST", "/evaluations", lambda answer: dict(answer.json()), body={"json": body}
                )
            )
        )


def _listed(points: ArrayLike) -> list[Any]:
    """Return points as nested lists, null for those that are not known."""
    array = np.asarray(points, np.float64)
    lists: list[Any] = array.tolist()
    for place in np.argwhere(~np.isfinite(array).all(-1)):
        *outer, last = place
        row = lists
        for index in outer:
            row = row[index]
        row[last] = None
    return lists
