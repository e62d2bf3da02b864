"""Answers of the service as frozen dataclasses; ``raw`` has the whole JSON object."""

import types
from collections.abc import Callable
from dataclasses import dataclass, field, fields, is_dataclass
from datetime import datetime
from functools import cache
from typing import Any, Generic, TypeVar, get_args, get_origin, get_type_hints

import httpx2
import numpy as np

from fewview.api.correction_forms import NOT_CORRECTED, CorrectionsState
from fewview.capture import Float64

Form = TypeVar("Form")


@dataclass(frozen=True)
class Finding:
    """Something that was noticed, and what to do about it.

    No views, frames or keypoints mean all of them. ``frames`` are ranges: the first and the last.
    ``remedy_fields`` are those of the API in which the remedy can be given.
    """

    code: str
    severity: str
    effect: str
    remedy: str
    views: tuple[int, ...] = ()
    frames: tuple[tuple[int, int], ...] = ()
    keypoints: tuple[int, ...] = ()
    evidence: dict[str, float] = field(default_factory=dict)
    remedy_fields: tuple[str, ...] = ()


@dataclass(frozen=True)
class Described:
    """A stored resource.

    Attributes
    ----------
    raw
        The whole JSON object, which may have more than the fields here.
    tags, metadata
        Its labels, for finding it again.
    """

    id: str
    name: str
    created_at: datetime
    raw: dict[str, Any] = field(repr=False, compare=False)
    tags: tuple[str, ...] = field(default=(), kw_only=True)
    metadata: dict[str, Any] = field(default_factory=dict, kw_only=True)


@dataclass(frozen=True)
class Page(Generic[Form]):
    """Items of a list; ``cursor`` asks for the next, None at the end."""

    items: tuple[Form, ...]
    cursor: str | None


@dataclass(frozen=True)
class Refusal:
    """What was not deleted, and why."""

    id: str
    code: str
    detail: str


@dataclass(frozen=True)
class Deleted:
    """Identifiers of what was deleted of many, and what was not."""

    deleted: tuple[str, ...]
    refused: tuple[Refusal, ...]


@dataclass(frozen=True)
class Dataset(Described):
    """A stored capture; ``keypoints`` and ``missing_fraction`` are per view."""

    frames: int
    views: int
    keypoints: int
    missing_fraction: tuple[float, ...]
    checksum: str
    findings: tuple[Finding, ...] = ()
    view_names: tuple[str, ...] | None = None
    corrections: CorrectionsState = NOT_CORRECTED  # keypoints that were corrected since


@dataclass(frozen=True)
class JobError:
    """Why a fit or a lift failed."""

    code: str
    message: str


@dataclass(frozen=True)
class Job(Described):
    """What fits and lifts have in common.

    Attributes
    ----------
    status
        ``queued``, ``running``, ``succeeded``, ``failed`` or ``cancelled``.
    frames
        Those that the dataset had when the job was made.
    """

    status: str
    dataset_id: str
    frames: int
    started_at: datetime | None
    finished_at: datetime | None
    error: JobError | None
    findings: tuple[Finding, ...] = ()
    corrections: CorrectionsState = NOT_CORRECTED  # of the dataset when the job was made

    @property
    def ended(self) -> bool:
        """Whether it has succeeded, failed or been cancelled."""
        return self.status not in ("queued", "running")


@dataclass(frozen=True)
class FitProgress:
    """How far a fit has come; ``reprojection_error`` is in pixels."""

    stage: str
    step: int
    steps: int
    loss: float | None
    reprojection_error: float | None
    seconds_left: float | None
    stopped_by: str | None = None


@dataclass(frozen=True)
class Verdict:
    """What may be relied on of a fit, by the finding of that ``code``; None if it is good.

    ``expected`` words its report: how far points may be off. None where there is none.
    """

    level: str  # good, caution or serious
    code: str | None
    reliable: str
    remedy: str  # what would help most
    expected: str | None = None


@dataclass(frozen=True)
class Fit(Job):
    """A job that turns a dataset into a model; ``model_id`` and ``verdict`` come with success.

    ``answer_stage`` is ``geometry`` when it has a first answer, ``network`` when it has succeeded.
    """

    config: dict[str, Any] | None = None
    from_model: str | None = None
    progress: FitProgress | None = None
    answer_stage: str | None = None
    model_id: str | None = None
    version: str | None = None  # of Fewview that made or ended it
    verdict: Verdict | None = None
    priority: str = "normal"


@dataclass(frozen=True)
class LiftProgress:
    """How far the lift of a dataset has come."""

    frames_done: int
    chunks_done: int
    chunks: int
    seconds_left: float | None


@dataclass(frozen=True)
class LiftJob(Job):
    """The lift of a stored dataset."""

    model_id: str = ""
    refine: str | None = None
    views: tuple[int, ...] | None = None
    frame: str = "canonical"
    uncertainty: str = "sd"
    progress: LiftProgress | None = None


@dataclass(frozen=True)
class Model(Described):
    """A fitted prior.

    Attributes
    ----------
    frames, views
        It was fitted to; None if it was imported.
    reprojection_error
        Pixels, mean over the views of the fitted frames.
    pa_mpjpe
        Mean Procrustes-aligned error against the ground truth, in its unit; None without one.
    """

    keypoints: int
    weights_bytes: int
    weights_checksum: str
    config: dict[str, Any]
    fit_id: str | None = None
    dataset_id: str | None = None
    frames: int | None = None
    views: int | None = None
    skeleton: dict[str, Any] | None = None
    reprojection_error: float | None = None
    frames_lifted: int | None = None
    pa_mpjpe: float | None = None
    pck: float | None = None
    pck_threshold: float | None = None
    version: str | None = None  # of Fewview whose fit made it; None if nobody noted it
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True, eq=False)
class FoundCamera:
    """The camera of one view, in OpenCV's terms; None where it was not estimated.

    Attributes
    ----------
    index
        Which view of the fit.
    static
        Whether it is static relative to the other static cameras.
    focal, principal_point
        (2,) pixels.
    distortion
        (8,) in OpenCV's order; of fisheyes k1 to k4, then zeros.
    rotation, translation
        (3, 3) and (3,) of ``x = R X + t``, t in units of the structures; None for a
        camera that moves.
    reprojection_error
        Pixels.
    raw
        The whole JSON object, with standard deviations (``..._sd``).
    """

    index: int
    camera: str
    static: bool
    focal: Float64 | None
    principal_point: Float64 | None
    distortion: Float64 | None
    rotation: Float64 | None
    translation: Float64 | None
    reprojection_error: float | None
    raw: dict[str, Any] = field(repr=False)


@dataclass(frozen=True, eq=False)
class Cameras:
    """The cameras that a fit estimated.

    Attributes
    ----------
    arrangement
        ``static``, ``moving``, ``mixed`` or ``unknown``; ``reason`` explains it.
    noise
        Pixels, the standard deviation of a keypoint's coordinate.
    model
        None of a fit that goes on.
    """

    model: str | None
    arrangement: str
    reason: str
    noise: float | None
    handedness_certainty: float | None
    views: tuple[FoundCamera, ...]
    findings: tuple[Finding, ...]
    raw: dict[str, Any] = field(repr=False)


@dataclass(frozen=True)
class Health:
    """Whether the service reaches its parts, and how many workers it has."""

    status: str
    workers: int
    raw: dict[str, Any] = field(repr=False, compare=False)


@dataclass(frozen=True)
class WaitingJobs:
    """What waits on a queue: jobs, seconds of the oldest, and the workers that take from it."""

    queue: str
    waiting: int
    oldest_seconds: float
    workers: int


@dataclass(frozen=True)
class Queues:
    """All queues."""

    items: tuple[WaitingJobs, ...]


@dataclass(frozen=True)
class Version:
    """What runs: the version of the service, and the number of its API."""

    service: str
    api: int


@dataclass(frozen=True)
class Alias:
    """A name for a model that can be moved to another model."""

    alias: str
    model_id: str
    moved_at: datetime


def form_in(form: type[Form]) -> Callable[[httpx2.Response], Form]:
    """Return what reads this form in a response."""
    return lambda response: read(form, response.json())


def page_of(form: type[Form]) -> Callable[[httpx2.Response], Page[Form]]:
    """Return what reads a page of items of this form in a response."""

    def read_page(response: httpx2.Response) -> Page[Form]:
        page = response.json()
        return Page(tuple(read(form, item) for item in page["items"]), page["next_cursor"])

    return read_page


def read(form: type[Form], document: dict[str, Any]) -> Form:
    """Return a JSON object of the service as a dataclass; unknown fields stay in ``raw``.

    Raises
    ------
    KeyError, TypeError, ValueError
        If a field is missing that has no default, or is of another kind.
    """
    hints = _hints(form)  # type: ignore[arg-type] # of Hashable
    found: dict[str, Any] = {"raw": document} if "raw" in hints else {}
    for name, hint in hints.items():
        if name in document:
            found[name] = _value(hint, document[name])
    return form(**found)


@cache
def _hints(form: Any) -> dict[str, Any]:
    hints = get_type_hints(form)
    return {item.name: hints[item.name] for item in fields(form)}


def _value(hint: Any, value: Any) -> Any:
    if isinstance(hint, types.UnionType):  # X | None
        return None if value is None else _value(get_args(hint)[0], value)
    kind = get_origin(hint) or hint
    if kind is tuple:
        return tuple(_value(get_args(hint)[0], item) for item in value)
    if kind is np.ndarray:
        return np.asarray(value, np.float64)
    if kind is datetime:
        return datetime.fromisoformat(value)
    if isinstance(kind, type) and is_dataclass(kind):
        return read(kind, value)
    return value
