"""Fits: jobs that turn a dataset into a model."""

from typing import Any

from fewview.api.arrays import SAFETENSORS
from fewview.api.forms import Dataset, Fit, Model, form_in
from fewview.api.jobs import Jobs
from fewview.api.lifting import Lift, identifier
from fewview.api.operations import Driver, operation
from fewview.api.steps import Request, Steps, once, path


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
        **config: Any,
    ) -> Steps[Fit]:
        """Queue a fit of a dataset.

        Parameters
        ----------
        from_model
            A model of the same keypoints whose weights are the first ones.
        config
            Fields of ``FitConfig`` in the API: ``steps``, ``cameras``, ``calibration``,
            ``known_length`` and more.

        Raises
        ------
        InvalidRequest
            The configuration is wrong, or not one for this dataset; ``errors`` say where.
        TooManyRequests
            Too many fits wait.
        """
        said = {
            "dataset_id": identifier(dataset),
            "name": name,
            "from_model": None if from_model is None else identifier(from_model),
            "config": config or None,
        }
        body = {key: value for key, value in said.items() if value is not None}
        return self._call(
            Request("POST", "/fits", form_in(Fit), headers=once(), body={"json": body})
        )

    @operation
    def reconstruction(self, fit: Fit | str, *, refine: str | None = None) -> Steps[Lift]:
        """Return all fitted frames in 3D.

        Parameters
        ----------
        refine
            ``auto``, ``full`` or ``off``: have them lifted anew, refined so.

        Raises
        ------
        Conflict
            The fit has not succeeded.
        """
        where = path("fits", identifier(fit), "reconstruction")
        headers = {"Accept": SAFETENSORS}
        return self._call(
            Request("GET", where, Lift.of, params={"refine": refine}, headers=headers)
        )
