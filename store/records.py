"""The tables. Times are seconds since the epoch (UTC); identifiers come from ``store.ids``."""

import time
from typing import Any, ClassVar

from sqlalchemy import JSON, BigInteger, Float, ForeignKey, Index, Integer, String, Text
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from store.account import counted, kept


class Record(DeclarativeBase):
    """Base of all tables."""

    type_annotation_map = {  # noqa: RUF012 (SQLAlchemy reads it from the class)
        str: String(200),
        int: Integer,
        float: Float(53),
        dict[str, Any]: JSON(none_as_null=True),
        list[Any]: JSON(none_as_null=True),
    }


DEFAULT_PROJECT = "default"


class Owned:
    """Columns of what belongs to a project, which sees nothing of the others'.

    ``key_id`` is the key that made it, if it was made with one, and ``stored_bytes`` are those of
    its objects and of the rows of its chunks. What the quota of that key counts is ``kept_bytes``,
    a column of each table: that, and the record itself (see ``store.account``).
    """

    project: Mapped[str] = mapped_column(
        String(64), default=DEFAULT_PROJECT, server_default=DEFAULT_PROJECT
    )
    key_id: Mapped[str | None]
    stored_bytes: Mapped[int] = mapped_column(BigInteger, default=0, server_default="0")


class Labelled:
    """Columns of names, tags and metadata; older records hold null.

    `unlisted` names the columns that are left out of lists.
    """

    unlisted: ClassVar[tuple[str, ...]] = ()
    name: Mapped[str] = mapped_column(index=True)
    tags: Mapped[list[Any] | None]
    user_metadata: Mapped[dict[str, Any] | None]


class Corrected:
    """Columns of what has corrections of keypoints; see ``store.corrections``.

    Rows ``[frame, view, keypoint, x, y]`` in their order, of removed keypoints without x and y.
    They may be many, so whoever needs them asks for them; the checksum is of them.
    """

    corrections: Mapped[list[Any] | None] = mapped_column(deferred=True)
    corrections_count: Mapped[int] = mapped_column(default=0, server_default="0")
    corrections_checksum: Mapped[str | None]


class DatasetRecord(Corrected, Labelled, Owned, Record):
    """A stored capture: what is known of it without reading its arrays."""

    noun: ClassVar = "dataset"  # in messages and URLs
    __tablename__ = "datasets"
    __table_args__ = (counted("datasets"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    created_at: Mapped[float]
    frames: Mapped[int] = mapped_column(BigInteger)
    views: Mapped[int]
    keypoints: Mapped[int]
    observed: Mapped[list[Any]]  # keypoints seen, a count per view
    confidence: Mapped[bool]  # some frames came with it
    ground_truth: Mapped[bool]
    checksum: Mapped[str]
    skeleton: Mapped[dict[str, Any] | None]
    image_sizes: Mapped[list[Any] | None]
    fps: Mapped[float | None]
    last_times: Mapped[list[Any] | None]  # seconds, of the last frame, one or one a view
    view_names: Mapped[list[Any] | None]
    calibration: Mapped[dict[str, Any] | None]  # file, names, cameras: what came with the capture
    notes: Mapped[list[Any] | None]  # of the reader of the files that it came in
    findings: Mapped[list[Any] | None]  # as JSON, see models.findings; None: never looked for
    kept_bytes: Mapped[int] = kept(
        *("tags", "user_metadata", "observed", "skeleton", "image_sizes"),
        *("last_times", "view_names", "notes", "findings", "calibration", "corrections"),
    )


class Chunk(Record):
    """Consecutive frames of a dataset, as one object."""

    __tablename__ = "chunks"

    dataset_id: Mapped[str] = mapped_column(
        ForeignKey("datasets.id", ondelete="CASCADE"), primary_key=True
    )
    first_frame: Mapped[int] = mapped_column(BigInteger, primary_key=True)
    frames: Mapped[int]
    key: Mapped[str]


class Job(Corrected, Labelled, Owned):
    """Columns of what the queue carries. ``status`` is the one truth about it.

    ``revision`` grows with every visible change. Its corrections are those that the dataset had
    when the job was made: it sees no others, however often it is started.
    """

    id: Mapped[str] = mapped_column(primary_key=True)
    created_at: Mapped[float] = mapped_column(default=time.time)
    started_at: Mapped[float | None]
    finished_at: Mapped[float | None]
    dataset_id: Mapped[str] = mapped_column(index=True)
    frames: Mapped[int] = mapped_column(BigInteger)  # of the dataset when the job was made
    job_id: Mapped[str] = mapped_column(unique=True)
    status: Mapped[str] = mapped_column(
        default="queued"
    )  # queued, running, succeeded, failed, cancelled
    revision: Mapped[int] = mapped_column(default=1)
    error: Mapped[dict[str, Any] | None]
    findings: Mapped[list[Any] | None]


class FitRecord(Job, Record):
    """A fit job.

    ``attempt`` is the fencing token: it grows with every claim, and a write that carries an older
    one changes nothing.
    """

    noun: ClassVar = "fit"
    __tablename__ = "fits"
    __table_args__ = (Index("fits_by_status", "status"), counted("fits"))

    config: Mapped[dict[str, Any]]
    from_model: Mapped[str | None] = mapped_column(index=True)  # whose weights it starts with
    priority: Mapped[str] = mapped_column(default="normal", server_default="normal")
    progress: Mapped[dict[str, Any] | None]
    cancel_requested_at: Mapped[float | None]
    attempt: Mapped[int] = mapped_column(default=0)
    crashes: Mapped[int] = mapped_column(default=0)  # with no step done between them
    crashed_at_step: Mapped[int | None]
    lease_expires_at: Mapped[float | None]
    checkpoint_key: Mapped[str | None]
    reconstruction_key: Mapped[str | None]
    first_key: Mapped[str | None]  # the first answer's reconstruction, while the fit goes on
    first_model_key: Mapped[str | None]  # and its model
    first_bytes: Mapped[int] = mapped_column(BigInteger, default=0, server_default="0")  # of both
    report_key: Mapped[str | None]
    report_words: Mapped[str | None] = mapped_column(Text)  # of the report, its verdict
    model_id: Mapped[str | None] = mapped_column(index=True)
    version: Mapped[str | None]  # of Fewview that ended it; None: it goes on, or nobody noted it
    kept_bytes: Mapped[int] = kept(
        *("tags", "user_metadata", "error", "findings", "config", "progress"),
        *("corrections", "report_words"),
    )


class LiftRecord(Job, Record):
    """The lift of a whole dataset. ``helpers`` counts the queue jobs that have worked at it."""

    noun: ClassVar = "lift"
    __tablename__ = "lifts"
    __table_args__ = (Index("lifts_by_status", "status"), counted("lifts"))

    model_id: Mapped[str] = mapped_column(index=True)
    refine: Mapped[str | None]
    views: Mapped[list[Any] | None]
    frame: Mapped[str | None]  # of reference: "canonical" or "room"; None of older versions
    # In the room: [x, y, z] or "auto".
    up: Mapped[Any] = mapped_column(JSON(none_as_null=True), nullable=True)
    uncertainty: Mapped[str | None]  # that the result has; None of older versions, which is "sd"
    helpers: Mapped[int] = mapped_column(default=0)
    chunks: Mapped[int] = mapped_column(default=0)
    chunks_done: Mapped[int] = mapped_column(default=0)
    frames_done: Mapped[int] = mapped_column(BigInteger, default=0)
    seconds_left: Mapped[float | None]
    layout: Mapped[list[Any] | None]  # of a frame's arrays, see store.lift_files
    kept_bytes: Mapped[int] = kept(
        "tags", "user_metadata", "error", "findings", "views", "up", "layout", "corrections"
    )


class LiftChunk(Record):
    """Consecutive frames of a lift.

    ``holder`` is the fencing token: who holds the lease. A write of anyone else changes nothing.
    """

    __tablename__ = "lift_chunks"

    lift_id: Mapped[str] = mapped_column(
        ForeignKey("lifts.id", ondelete="CASCADE"), primary_key=True
    )
    first_frame: Mapped[int] = mapped_column(BigInteger, primary_key=True)
    frames: Mapped[int]
    holder: Mapped[str | None]
    lease_expires_at: Mapped[float | None]
    crashes: Mapped[int]
    finished_at: Mapped[float | None]  # None: still to be done
    arrays_key: Mapped[str | None]
    lines_key: Mapped[str | None]
    lines_bytes: Mapped[int | None]
    checksums: Mapped[dict[str, Any] | None]  # CRC-32 of each array's bytes


class ModelRecord(Labelled, Owned, Record):
    """A fitted prior: its weights are an object, its figures are here."""

    noun: ClassVar = "model"
    unlisted: ClassVar = ("training_curve",)  # long, and in no list
    __tablename__ = "models"
    __table_args__ = (counted("models"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    created_at: Mapped[float]
    fit_id: Mapped[str | None] = mapped_column(index=True)
    dataset_id: Mapped[str | None] = mapped_column(index=True)
    views: Mapped[int | None]
    keypoints: Mapped[int]
    frames: Mapped[int | None] = mapped_column(BigInteger)
    config: Mapped[dict[str, Any]]
    skeleton: Mapped[dict[str, Any] | None]
    training_curve: Mapped[list[Any]]
    metrics: Mapped[dict[str, Any]]
    weights_key: Mapped[str]
    weights_bytes: Mapped[int]
    weights_checksum: Mapped[str]
    version: Mapped[str | None]  # of Fewview that fitted it; None: nobody noted it
    findings: Mapped[list[Any] | None]
    kept_bytes: Mapped[int] = kept(
        *("tags", "user_metadata", "config", "skeleton", "training_curve", "metrics", "findings")
    )


class ModelAlias(Owned, Record):
    """A name of a model that can be moved to another; see ``store.aliases``."""

    noun: ClassVar = "alias"
    __tablename__ = "aliases"
    __table_args__ = (counted("aliases"),)

    project: Mapped[str] = mapped_column(
        String(64), primary_key=True, server_default=DEFAULT_PROJECT
    )
    name: Mapped[str] = mapped_column(primary_key=True)
    model_id: Mapped[str] = mapped_column(ForeignKey("models.id"), index=True)
    moved_at: Mapped[float]
    kept_bytes: Mapped[int] = kept()


class WebhookRecord(Owned, Record):
    """A URL that is notified when jobs of a project end; see ``store.webhooks``."""

    noun: ClassVar = "webhook"
    __tablename__ = "webhooks"
    __table_args__ = (counted("webhooks"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    created_at: Mapped[float]
    url: Mapped[str] = mapped_column(Text)
    events: Mapped[list[Any]]
    secret: Mapped[str]
    kept_bytes: Mapped[int] = kept("url", "events")


class Delivery(Owned, Record):
    """A message to a webhook. ``attempts`` is the fencing token of who attempts it.

    It is of the webhook's project and key.
    """

    __tablename__ = "deliveries"
    __table_args__ = (counted("deliveries"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    webhook_id: Mapped[str] = mapped_column(
        ForeignKey("webhooks.id", ondelete="CASCADE"), index=True
    )
    event: Mapped[str]
    payload: Mapped[str] = mapped_column(Text)  # JSON, the very text that is signed
    created_at: Mapped[float]
    attempts: Mapped[int]
    next_at: Mapped[float | None] = mapped_column(index=True)  # None: there will be no attempt
    delivered_at: Mapped[float | None]
    outcome: Mapped[str | None]  # of the last attempt, in words
    kept_bytes: Mapped[int] = kept("payload")


class Deployment(Record):
    """The one row with the identity of the deployment: see ``store.deployment``."""

    __tablename__ = "deployment"

    id: Mapped[str] = mapped_column(primary_key=True)
    created_at: Mapped[float]
    marked_at: Mapped[float | None]  # when the objects were known to carry it, too
    next_sweep_at: Mapped[float | None]


class CondemnedObject(Record):
    """An object that no record points to, and that the first sweep after ``due_at`` deletes."""

    __tablename__ = "condemned_objects"

    key: Mapped[str] = mapped_column(primary_key=True)
    due_at: Mapped[float]


class IdempotencyKey(Owned, Record):
    """What a creating request with this key made."""

    __tablename__ = "idempotency_keys"
    __table_args__ = (counted("idempotency_keys"),)

    scope: Mapped[str] = mapped_column(primary_key=True)
    key: Mapped[str] = mapped_column(primary_key=True)
    fingerprint: Mapped[str]
    resource_id: Mapped[str]
    created_at: Mapped[float]
    kept_bytes: Mapped[int] = kept()


class AccessKey(Record):
    """What lets a client in. Of its token only the SHA-256 is kept."""

    noun: ClassVar = "key"
    __tablename__ = "keys"

    id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str]
    project: Mapped[str] = mapped_column(String(64))
    digest: Mapped[str] = mapped_column(unique=True)
    scopes: Mapped[list[Any]]
    quotas: Mapped[dict[str, Any] | None]  # of store.access_keys.Quotas; None: none
    created_at: Mapped[float]
    expires_at: Mapped[float | None]
    revoked_at: Mapped[float | None]


class AuditRecord(Record):
    """Who changed what: written in the transaction of the change, and never changed itself."""

    __tablename__ = "audit"
    __table_args__ = (counted("audit"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    at: Mapped[float] = mapped_column(index=True)
    project: Mapped[str] = mapped_column(String(64))
    key_id: Mapped[str]  # or who it was without one: see store.authors
    action: Mapped[str]
    target: Mapped[str]  # identifier of the record
    request_id: Mapped[str | None]
    kept_bytes: Mapped[int] = kept(objects=False)
