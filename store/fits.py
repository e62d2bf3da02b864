"""Fits: the state machine of a fit job.

    queued ──claim──▶ running ──▶ succeeded | failed | cancelled
      ▲  │               │
      │  └──cancel───────┼──────▶ cancelled
      └──released, or its lease expired

Only the attempt that holds the lease may write; terminal states are never left. The queue only
carries work to workers: its status of a job is never used.
"""

from collections.abc import Callable, Sequence
from typing import Any

from sqlalchemy import Row, select, update
from sqlalchemy.orm import Session

from models.settings.calibration import Keypoint
from models.settings.config import FitConfig, warm
from models.settings.lenses import Lens, LensError, known_lenses, lens_of_each_view
from models.settings.priors import ARCHITECTURE
from store import clock, corrections, datasets, jobs, webhooks
from store.answers import PROVISIONAL, provisional_keys
from store.authors import author_of, owned_by
from store.capture import Capture
from store.database import Store
from store.disposal import condemn
from store.errors import ConfigError, NotFoundError, SourceError
from store.idempotency import Idempotency
from store.jobs import Priority
from store.labels import Labels
from store.lookup import lock
from store.mistakes import unknown
from store.records import DatasetRecord, FitRecord, LiftRecord, ModelRecord
from store.version import VERSION


def create(
    store: Store,
    *,
    dataset_id: str,
    name: str,
    config: dict[str, Any],
    from_model: str | None = None,
    priority: Priority = "normal",
    labels: Labels = Labels(),  # noqa: B008 (never changed)
    job_id: str | None = None,
    max_queued: int | None = None,
    idempotency: Idempotency | None = None,
) -> FitRecord:
    """Record a queued fit of the dataset as it is now.

    ``config`` has fields of :class:`models.settings.config.FitConfig`. The others are filled in
    with defaults, or with those for a start from the model ``from_model``. Keypoints that are given
    by name are stored as their indices in the dataset. ``priority`` orders fits of one project.

    A ``job_id`` that already has a fit gives that fit back; without one, the fit's own identifier
    is its job's.

    Raises
    ------
    NotFoundError
        If there is no such dataset, or no such model.
    ConfigError
        If the configuration names views or keypoints that the dataset does not have, or another
        prior or other sizes of it than the model's.
    SourceError
        If the model has other keypoints than the dataset.
    QueueFullError
        If ``max_queued`` fits wait already.
    """

    def make(session: Session, fit_id: str) -> FitRecord:
        # Locked against deletion, so that no fit is queued of a dataset that is gone.
        dataset = lock(session, DatasetRecord, dataset_id)
        complete = _by_index(FitConfig.model_validate(config), dataset)
        source = None
        if from_model is not None:
            source = lock(
                session, ModelRecord, from_model, dataset.project
            )  # against deletion, too
            complete = _suited(complete, source, dataset)
        filled_in = complete.model_dump(mode="json")
        _check(filled_in, dataset)
        return FitRecord(
            id=fit_id,
            name=name,
            dataset_id=dataset_id,
            frames=dataset.frames,
            config=filled_in,
            from_model=source and source.id,
            priority=priority,
            job_id=job_id or fit_id,
            **corrections.columns(corrections.of(session, DatasetRecord, dataset_id)),
            **owned_by(author_of(session)) | {"project": dataset.project},
            **labels.columns(),
        )

    return jobs.create(
        store, FitRecord, make, job_id=job_id, max_queued=max_queued, idempotency=idempotency
    )


def _suited(config: FitConfig, model: ModelRecord, dataset: DatasetRecord) -> FitConfig:
    """Fill in a configuration for a start from a model; raise for one that does not suit it."""
    if model.project != dataset.project:  # jobs may be queued for all projects
        raise NotFoundError(ModelRecord.noun, model.id)
    if model.keypoints != dataset.keypoints:
        raise SourceError(
            "from_model",
            f"a fit can start from a model of the same keypoints only: expected "
            f"{dataset.keypoints} as in the dataset, got {model.keypoints}",
        )
    source = FitConfig.model_validate(model.config)
    has, given = source.model_dump(mode="json"), config.model_dump(mode="json", exclude_unset=True)
    for field in ARCHITECTURE:
        if given.get(field, has[field]) != has[field]:
            raise ConfigError(
                field,
                f"a fit keeps the prior and the sizes of the model it starts from: expected "
                f"{has[field]}, got {given[field]}; leave it out",
            )
    return warm(config, source)


def _by_index(config: FitConfig, dataset: DatasetRecord) -> FitConfig:
    """Return a configuration with keypoints by index; raise ``ConfigError`` for an unknown name."""
    names = (dataset.skeleton or {}).get("keypoint_names") or []

    def index(keypoint: Keypoint, field: str) -> int:
        if isinstance(keypoint, int):
            return keypoint
        if not names:
            raise ConfigError(
                field,
                "the keypoints of this dataset have no names: use the index, from 0, or give "
                "the dataset a skeleton with `keypoint_names`",
            )
        if keypoint not in names:
            raise ConfigError(field, unknown("keypoint", keypoint, names))
        return int(names.index(keypoint))

    def indices(keypoints: Sequence[Keypoint], field: str) -> tuple[int, ...]:
        return tuple(index(given, f"{field}/{place}") for place, given in enumerate(keypoints))

    found: dict[str, Any] = {}
    if config.known_length is not None:
        ends = indices(config.known_length.keypoints, "known_length/keypoints")
        found["known_length"] = config.known_length.model_copy(update={"keypoints": ends})
    if config.handedness is not None:
        found["handedness"] = indices(config.handedness, "handedness")
    return config.model_copy(update=found)


def _check(config: dict[str, Any], dataset: DatasetRecord) -> None:
    """Raise ``ConfigError`` for errors that only the dataset reveals."""
    calibration, known_length = config.get("calibration"), config.get("known_length")
    if calibration is not None and len(calibration) != dataset.views:
        raise ConfigError(
            "calibration",
            f"the calibration must have an entry per view: expected {dataset.views}, got "
            f"{len(calibration)}; write null for a view of which nothing is known",
        )
    _check_lenses(config.get("lenses"), dataset)
    _check_distance(config.get("known_distance"), config["cameras"], dataset)
    for field, found in (
        ("known_length", known_length and known_length["keypoints"]),
        ("handedness", config.get("handedness")),
    ):
        if found and (len(set(found)) < len(found) or max(found) >= dataset.keypoints):
            raise ConfigError(
                field,
                f"{field} must name {len(found)} different keypoints below {dataset.keypoints}, "
                f"got {list(found)}",
            )


def _check_distance(given: dict[str, Any] | None, cameras: str, dataset: DatasetRecord) -> None:
    """Raise ``ConfigError`` for a distance of cameras that are not there, or that move."""
    if given is None:
        return
    views = given["views"]
    if len(set(views)) < len(views) or max(views) >= dataset.views:
        raise ConfigError(
            "known_distance/views",
            f"known_distance must name 2 different views below {dataset.views}, got {list(views)}",
        )
    if cameras == "moving":
        raise ConfigError(
            "known_distance",
            "known_distance needs two cameras that are static, got `cameras: moving`: leave one of "
            "them out, or give a known_length",
        )


def _check_lenses(given: list[Any] | None, dataset: DatasetRecord) -> None:
    """Raise ``ConfigError`` for lenses that the views or the sizes of their images do not allow."""
    if given is None:
        return
    sizes = [size and tuple(size) for size in dataset.image_sizes or [None] * dataset.views]
    lenses = [None if lens is None else Lens.model_validate(lens) for lens in given]
    try:
        known_lenses(lens_of_each_view(lenses, dataset.views), sizes)
    except LensError as error:
        place = error.view if len(lenses) > 1 else 0
        raise ConfigError(f"lenses/{place}", error.words) from error
    except ValueError as error:
        raise ConfigError("lenses", str(error)) from error


def cancel(store: Store, fit_id: str) -> FitRecord:
    """Cancel a queued fit at once, or ask the attempt that runs it to stop.

    Cancelling a cancelled fit is no error.

    Raises
    ------
    NotFoundError
        If there is no such fit.
    ConflictError
        If it has ended otherwise.
    """
    with store.writing() as session:
        fit = jobs.lock_to_cancel(session, FitRecord, fit_id)
        now = clock.read(session)
        if fit.status != "cancelled" and fit.cancel_requested_at is None:
            fit.cancel_requested_at = now
            fit.revision += 1
        abandoned = fit.lease_expires_at is not None and fit.lease_expires_at < now
        if fit.status == "queued" or (fit.status == "running" and abandoned):
            _end(session, fit, "cancelled", now)
    return fit


def recover(
    store: Store, *, expired: bool = True, on_loss: Callable[[], None] = lambda: None
) -> Sequence[Row[str, str]]:
    """Deal with fits whose attempt died; return `id` and `job_id` of all that wait, oldest first.

    A fit whose lease ran out is queued again, or cancelled if that was asked, or failed if it has
    taken down too many workers.

    Parameters
    ----------
    expired
        Whether a lease that ran out means that the attempt died. It does not if the records could
        not be reached until just now, for then no lease could be renewed.
    on_loss
        Called for each fit that was taken from an attempt that died.
    """
    lost = (FitRecord.status == "running") & (FitRecord.lease_expires_at < clock.now())
    waiting = select(FitRecord.id, FitRecord.job_id).where(FitRecord.status == "queued")
    with store.reading() as session:  # the common case takes no write lock
        any_lost = session.scalar(select(FitRecord.id).where(lost).limit(1)) is not None
    if any_lost:
        with store.writing() as session:
            now, prompt = clock.read_promptly(session)
            dead = select(FitRecord).where(lost).with_for_update(skip_locked=True)
            taken = list(session.scalars(dead)) if expired and prompt else []
            for fit in taken:
                lose(
                    session,
                    fit,
                    now,
                    "worker_lost",
                    "the worker died each time; it may have run out of memory. Try fewer frames "
                    "or smaller dictionaries.",
                )
        for _ in taken:
            on_loss()
    with store.reading() as session:
        return session.execute(waiting.order_by(FitRecord.id)).all()


def lose(session: Session, fit: FitRecord, now: float, code: str, why: str) -> None:
    """Queue a fit again whose attempt died or met an error; cancel it if that was asked.

    A fit fails, with ``code`` and ``why``, after `MAX_CRASHES` such attempts in a row without
    progress.
    """
    step = (fit.progress or {}).get("step", 0)
    got_further = fit.crashed_at_step is not None and step > fit.crashed_at_step
    fit.crashes = 1 if got_further else fit.crashes + 1
    fit.crashed_at_step = step
    fit.revision += 1
    fit.lease_expires_at = None
    if fit.cancel_requested_at is not None:
        _end(session, fit, "cancelled", now)
    elif fit.crashes >= jobs.MAX_CRASHES:
        fit.error = {"code": code, "message": f"Tried {fit.crashes} times: {why}"}
        _end(session, fit, "failed", now)
    else:
        fit.status = "queued"


def enforce_cancel(store: Store, job_id: str, *, patience_seconds: float) -> bool:
    """Take a running fit from an attempt that has not heeded a request to cancel.

    Returns
    -------
    bool
        Whether it was taken; the process that runs it must then be stopped.
    """
    mine = (FitRecord.job_id == job_id) & (FitRecord.status == "running")
    heeds_not = FitRecord.cancel_requested_at <= clock.now() - patience_seconds
    with store.reading() as session:
        if session.scalar(select(FitRecord.id).where(mine, heeds_not)) is None:
            return False
    with store.writing() as session:
        locked = select(*PROVISIONAL).where(mine).with_for_update()
        condemn(session, [key for keys in session.execute(locked) for key in keys])
        taken = session.scalar(
            update(FitRecord).where(mine).values(**ended("cancelled")).returning(FitRecord)
        )
        if taken is not None:
            webhooks.announce(session, taken)
    return taken is not None


def delete(store: Store, fit_id: str) -> None:
    """Delete a fit that has ended, its reconstruction and its report; its model stays.

    Raises as :func:`store.jobs.delete` does, and ``ConflictError`` while a lift uses the
    reconstruction for up or the floor of its room: its parts would otherwise be in different rooms.
    """

    def forget(session: Session, fit: FitRecord) -> list[str]:
        session.execute(update(ModelRecord).where(ModelRecord.fit_id == fit_id).values(fit_id=None))
        of_model = LiftRecord.model_id == fit.model_id  # locked by now: no lift of it begins
        jobs.refuse_if_used(
            session, "Fit", fit_id, LiftRecord, of_model, LiftRecord.up.is_not(None)
        )
        keys = fit.reconstruction_key, fit.report_key, *provisional_keys(fit)
        return [key for key in keys if key is not None]

    jobs.delete(store, FitRecord, fit_id, forget)


def ended(status: str) -> dict[str, Any]:
    """Return the columns of a fit that ends now, without checkpoint and first answer."""
    return {
        "status": status,
        "finished_at": clock.now(),
        "version": VERSION,
        "lease_expires_at": None,
        "findings": None,
        "stored_bytes": 0,
        "first_bytes": 0,
        "revision": FitRecord.revision + 1,
        **{column.key: None for column in PROVISIONAL},
    }


def _end(session: Session, fit: FitRecord, status: str, now: float) -> None:
    condemn(session, provisional_keys(fit))
    for name, value in ended(status).items():
        if name != "revision":  # which has grown
            setattr(fit, name, value)
    fit.finished_at = now
    webhooks.announce(session, fit)


def load_fitted(store: Store, fit: FitRecord) -> Capture:
    """Return the capture that a fit sees: its frames, with the corrections it was made with.

    Raises ``NotFoundError`` if the dataset was deleted.
    """
    with store.reading() as session:
        corrected = corrections.of(session, FitRecord, fit.id)
    return datasets.load(store, fit.dataset_id, frames=fit.frames, corrected=corrected)
