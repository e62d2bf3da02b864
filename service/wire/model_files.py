"""A model as a file: its weights, and in their header what else is known of it.

The weights themselves know configuration, curve, cameras and findings. An export adds an entry
`model` to the metadata of the safetensors header, and an import takes it off: so the weights that
are stored are the same before and after.
"""

import json
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from models.numerics.tensor_files import MAX_HEADER, WeightsError
from models.settings.keypoints import MAX_VIEWS
from service.http.errors import from_validation
from service.wire.schemas import Name
from service.wire.skeletons import Skeleton
from store import records
from store.labels import Labels, labels_of

ENTRY = "model"  # in the metadata of a file
ALIGNMENT = 8  # bytes, of what follows the header

Count = Annotated[int, Field(ge=1, le=2**53)]
Figure = Annotated[float, Field(ge=0, allow_inf_nan=False)] | None


class ModelFigures(BaseModel):
    """The errors of a model measured in its fit, as in `GET /models/{id}`."""

    reprojection_error: Figure = None
    frames_lifted: Annotated[int, Field(ge=0, le=2**53)] | None = None
    pa_mpjpe: Figure = None
    pck: Figure = None
    pck_threshold: Figure = None


class ModelDescription(Labels):
    """What is known of a model and not in its weights. What is not known here is ignored."""

    model_config = ConfigDict(strict=True, extra="ignore")

    name: Name | None = None
    views: Annotated[int, Field(ge=1, le=MAX_VIEWS)] | None = None
    frames: Count | None = None
    skeleton: Skeleton | None = None
    version: Annotated[str, Field(max_length=100)] | None = None  # of Fewview whose fit made it
    metrics: ModelFigures = ModelFigures()

    @classmethod
    def of(cls, model: records.ModelRecord) -> Self:
        """Return the description of a model from its record."""
        fields = ("name", "views", "frames", "skeleton", "version", "metrics")
        values = {field: getattr(model, field) for field in fields} | labels_of(model)
        return cls.model_validate(values, strict=False)


def described(weights: bytes, description: ModelDescription) -> bytes:
    """Return weights (safetensors) with a description in their header."""
    header, tensors = _split(weights)
    header["__metadata__"][ENTRY] = description.model_dump_json()
    return _joined(header, tensors)


def taken_apart(data: bytes) -> tuple[bytes, ModelDescription]:
    """Return the weights in a file without their description, and that; it is empty in older files.

    Raises
    ------
    WeightsError
        If this is no file of weights.
    ApiError
        If the description is none.
    """
    header, tensors = _split(data)
    entry = header["__metadata__"].pop(ENTRY, None)
    if entry is None:
        return data, ModelDescription()
    try:
        return _joined(header, tensors), ModelDescription.model_validate_json(entry)
    except ValidationError as error:
        raise from_validation(error, ModelDescription) from error


def _split(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the header of a file, and what follows it."""
    size = int.from_bytes(data[:8], "little")
    if not 0 < size <= min(MAX_HEADER, len(data) - 8):
        raise WeightsError("expected a safetensors file, but the header is cut off or not one")
    try:
        header = json.loads(data[8 : 8 + size])
        metadata = header["__metadata__"]
        if not all(isinstance(value, str) for value in metadata.values()):
            raise WeightsError("the metadata of a safetensors file are texts, these are not")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise WeightsError("expected a file written by fewview, got another one") from error
    return header, data[8 + size :]


def _joined(header: dict[str, Any], tensors: bytes) -> bytes:
    """Return a file as the safetensors library writes it: equal headers are equal bytes."""
    try:
        text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        raise WeightsError("the header of the file is no valid Unicode") from error
    text += b" " * (-len(text) % ALIGNMENT)
    return len(text).to_bytes(8, "little") + text + tensors
