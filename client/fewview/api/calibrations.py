"""Given cameras of a dataset, in the form of requests."""

from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from typing import Any

from fewview.api.forms import Dataset, form_in
from fewview.api.steps import Request, Steps, path
from fewview.calibration import Camera, as_config, read_for_views

Calibration = str | PathLike[str] | Sequence[Camera | Mapping[str, Any] | None]


def in_request_form(
    call: Callable[[Request[Dataset]], Steps[Dataset]], calibration: Calibration, dataset_id: str
) -> Steps[list[Any]]:
    """Return a calibration in the API's form, with an entry for each view of a dataset.

    Raises
    ------
    FormatError
        It is a file that cannot be read, or its cameras do not fit the views.
    """
    if isinstance(calibration, str | PathLike):
        stored = yield from call(Request("GET", path("datasets", dataset_id), form_in(Dataset)))
        calibration, _ = read_for_views(calibration, stored.view_names, stored.views)
    return [as_config(view) if isinstance(view, Camera) else view for view in calibration]
