"""Models: fitted priors, their cameras and their weights."""

import json
from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from fewview.api.downloads import download
from fewview.api.forms import Alias, Cameras, Model, Page, form_in, page_of
from fewview.api.lifting import identifier
from fewview.api.operations import Driver, listing, operation
from fewview.api.steps import Request, Steps, once, path
from fewview.api.stored import Stored, labels


class Models(Stored[Driver, Model]):
    """``/models``; a fit outlives its model."""

    _form = Model
    _plural = "models"

    @operation
    def set_alias(self, alias: str, model: Model | str) -> Steps[Alias]:
        """Point an alias, such as ``walk@production``, to a model.

        It can be used in place of a model's id. ``delete("walk@production")`` deletes only it.

        Raises
        ------
        NotFound
            There is no such model.
        """
        body = {"model_id": identifier(model)}
        request = Request("PUT", path("models", alias), form_in(Alias), body={"json": body})
        return self._call(request)

    @listing
    def aliases(self, model: Model | str | None = None) -> Request[Page[Alias]]:
        """Iterate over the aliases by their names; of one model if it is given."""
        of = None if model is None else identifier(model)
        return Request("GET", "/aliases", page_of(Alias), params={"model_id": of})

    @operation
    def cameras(self, model: Model | str) -> Steps[Cameras]:
        """Return the cameras that the fit estimated."""
        where = path("models", identifier(model), "cameras")
        return self._call(Request("GET", where, form_in(Cameras)))

    @operation
    def calibration(self, model: Model | str, format: str) -> Steps[bytes]:
        """Return its cameras as a calibration file: ``anipose``, ``opencv``, ``colmap`` (a zip).

        Raises
        ------
        Conflict
            The format cannot describe these cameras.
        """
        where = path("models", identifier(model), "cameras")
        request = Request("GET", where, lambda found: found.content, params={"format": format})
        return self._call(request)

    @operation
    def download(self, model: Model | str, file: str | PathLike[str]) -> Steps[Path]:
        """Download a model into a file; an interrupted download continues where it stopped.

        The file has the whole model as safetensors, or only the network if its name ends in
        ``.onnx``.

        Raises
        ------
        Conflict
            The network cannot be exported to ONNX.
        """
        file = Path(file)
        part = "network" if file.suffix.lower() == ".onnx" else "weights"
        return download(path("models", identifier(model), part), file, self._patience)

    @operation
    def upload(
        self,
        file: str | PathLike[str],
        *,
        name: str | None = None,
        tags: Iterable[str] = (),
        metadata: Mapping[str, Any] | None = None,
    ) -> Steps[Model]:
        """Store weights that were downloaded from this or another Fewview.

        Raises
        ------
        InvalidRequest
            The file holds no weights.
        """
        form = {key: json.dumps(value) for key, value in labels(tags, metadata).items()}
        if name is not None:
            form["name"] = name
        content = Path(file).read_bytes()
        request = Request(
            "POST",
            "/models",
            form_in(Model),
            headers=once(),
            body={"data": form, "files": {"file": ("model.safetensors", content)}},
        )
        return self._call(request)
