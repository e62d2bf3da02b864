"""Models: fitted priors, their cameras and their weights."""

from os import PathLike
from pathlib import Path
from typing import Any

from fewview.api.downloads import download
from fewview.api.forms import Cameras, Model, form_in, page_of
from fewview.api.lifting import identifier
from fewview.api.operations import Driver, Page, Resource, listing, operation
from fewview.api.steps import Request, Steps, nothing, once, path


class Models(Resource[Driver]):
    """``/models``."""

    @operation
    def get(self, model_id: str) -> Steps[Model]:
        """Describe a model: configuration, errors, findings."""
        return self._call(Request("GET", path("models", model_id), form_in(Model)))

    @listing
    def list(self, /, **filters: Any) -> Request[Page[Model]]:
        """Iterate over all models, newest first.

        Parameters
        ----------
        filters
            Those of the API's query, such as ``name="macaque"``.
        """
        return Request("GET", "/models", page_of(Model), params=filters)

    @operation
    def cameras(self, model: Model | str) -> Steps[Cameras]:
        """Tell what the fit found out about its cameras."""
        where = path("models", identifier(model), "cameras")
        return self._call(Request("GET", where, form_in(Cameras)))

    @operation
    def download(self, model: Model | str, file: str | PathLike[str]) -> Steps[Path]:
        """Download a model's weights into a file; what broke off goes on where it was."""
        return download(path("models", identifier(model), "weights"), Path(file), self._patience)

    @operation
    def upload(self, file: str | PathLike[str], *, name: str | None = None) -> Steps[Model]:
        """Store weights that were downloaded from this or another Fewview.

        Raises
        ------
        InvalidRequest
            The file holds no weights.
        """
        request = Request(
            "POST",
            "/models",
            form_in(Model),
            params={"name": name},
            headers={**once(), "Content-Type": "application/octet-stream"},
            body={"content": Path(file).read_bytes()},
        )
        return self._call(request)

    @operation
    def delete(self, model: Model | str) -> Steps[None]:
        """Delete a model and its weights.

        Raises
        ------
        Conflict
            A lift that has not ended needs it.
        """
        return self._call(Request("DELETE", path("models", identifier(model)), nothing))
