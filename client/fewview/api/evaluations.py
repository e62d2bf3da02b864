"""Evaluations: structures and cameras against a truth, computed by the service."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fewview.api.forms import Dataset, Fit
from fewview.api.lifting import identifier
from fewview.api.operations import Driver, Resource, operation
from fewview.api.steps import Request, Steps
from fewview.calibration import Camera, as_config

Calibration = Sequence[Camera | Mapping[str, Any] | None]


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
        **options: Any,
    ) -> Steps[dict[str, Any]]:
        """Measure a fit's structures, or others, and return the figures as the API words them.

        Parameters
        ----------
        points, truth
            (N, P, 3), NaN where not known.
        dataset
            One with a ground truth; None: that of the fit.
        calibration
            True cameras of the views, as :func:`fewview.calibration.read_cameras` gives them.
        options
            ``frame``, ``reach``, ``mirrored_too``, ``triangulate``: as in the API.

        Raises
        ------
        InvalidRequest
            These cannot be compared; ``errors`` say why.
        """
        said = {
            "fit_id": None if fit is None else identifier(fit),
            "dataset_id": None if dataset is None else identifier(dataset),
            "points": None if points is None else _listed(points),
            "truth": None if truth is None else _listed(truth),
            "calibration": calibration
            and [as_config(view) if isinstance(view, Camera) else view for view in calibration],
            **options,
        }
        body = {key: value for key, value in said.items() if value is not None}
        return self._call(
            Request("POST", "/evaluations", lambda told: dict(told.json()), body={"json": body})
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
