"""How fits and lifts are carried and bounded."""

from typing import Annotated, Literal, get_args

from pydantic import AnyUrl, Field, UrlConstraints, field_validator
from typing_extensions import TypeAliasType

from store.retention import Retention
from store.settings import StoreSettings
from worker.logs import LogFormat

QueueName = TypeAliasType("QueueName", Literal["lifts", "fits", "gpu-fits"])
QUEUES: tuple[QueueName, ...] = get_args(QueueName.__value__)
QueueUrl = Annotated[AnyUrl, UrlConstraints(allowed_schemes=["redis", "rediss", "unix"])]


class WorkerSettings(StoreSettings):
    """Settings of the queue and its workers."""

    redis_url: QueueUrl | None = Field(
        None,
        description="Redis or Valkey that carries the jobs, by TCP or by the path of its socket. "
        "Without it, `fewview serve` starts an embedded Valkey.",
        examples=["redis://localhost:6379/0", "unix:///run/valkey/valkey.sock"],
    )
    takes: str = Field(
        ",".join(QUEUES),
        description="What a worker takes, separated by commas: `lifts`; `fits`; `gpu-fits`, which "
        "a GPU takes sooner than a processor. In turn, where several wait. Default: all.",
    )
    cores: int | None = Field(
        None,
        ge=1,
        le=1024,
        description="Processor cores for finding the cameras of a fit, which is short. Default: "
        "those that the worker may use, shared with the others that `fewview serve` started.",
    )
    lease_seconds: float = Field(
        10.0,
        ge=2,
        le=600,
        description="A fit, or a part of a big lift, whose worker has not been heard of for this "
        "long is given to another.",
    )
    checkpoint_seconds: float = Field(
        2.0,
        ge=0.1,
        le=3600,
        description="Time between two checkpoints of a running fit.",
    )
    fit_threads: int = Field(
        1,
        ge=1,
        le=256,
        description="Processor cores for one fit or lift. Small dictionaries gain nothing from "
        "more, and lose much where other processes want the cores; a fit's last digits depend on "
        "it.",
    )
    fit_device: Literal["auto", "cpu", "cuda"] = Field(
        "auto",
        description="Where training steps are taken. `auto`: on a GPU if there is one and the "
        "dictionaries are large enough for it to pay, else on the processor.",
    )
    max_fit_seconds: int = Field(
        6 * 3600, ge=1, le=7 * 24 * 3600, description="A fit that runs longer fails."
    )
    lift_chunk_frames: int = Field(
        4096,
        ge=1,
        le=100_000,
        description="Most frames of a big lift that a worker does in one go: what is lost if it is "
        "killed, and kept in its memory. Fewer where there are many views and keypoints.",
    )
    keep_fits_days: float | None = Field(
        None,
        ge=0,
        description="Days after which fits that succeeded are deleted, with their reconstruction; "
        "their models stay. Default: never.",
    )
    keep_lifts_days: float | None = Field(
        None,
        ge=0,
        description="Days after which lifts that succeeded are deleted. Default: never.",
    )
    keep_failed_days: float | None = Field(
        None,
        ge=0,
        description="Days after which fits and lifts that failed or were cancelled are deleted. "
        "Default: never.",
    )
    keep_audit_days: float | None = Field(
        365,
        ge=0,
        description="Days after which entries of the audit are deleted.",
    )
    lift_turn_seconds: float = Field(
        30.0,
        ge=0.1,
        le=3600,
        description="Time a big lift may have a worker for itself while other jobs wait.",
    )
    fit_turn_seconds: float = Field(
        300.0,
        ge=1,
        le=24 * 3600,
        description="Time a fit may have a worker for itself while jobs of other projects or keys "
        "wait. It is saved then, and goes on when it is its turn again.",
    )

    webhook_private_targets: bool = Field(
        False,
        description="Whether webhooks may name hosts of private networks and of this machine, and "
        "`http://`. Clients that may make webhooks can then reach all that workers reach.",
    )

    log_format: LogFormat = Field(
        "text",
        description="How lines of the log are written, on stderr: `text`, or `json`, an object a "
        "line.",
    )

    @field_validator("takes")
    @classmethod
    def _are_queues(cls, takes: str) -> str:
        names = listed(takes)
        if not names or set(names) - set(QUEUES) or len(set(names)) < len(names):
            raise ValueError(f"expected some of {', '.join(QUEUES)}, each once; got {takes!r}")
        return takes

    @property
    def retention(self) -> Retention:
        """For how long what has ended is kept."""
        return Retention(
            self.keep_fits_days, self.keep_lifts_days, self.keep_failed_days, self.keep_audit_days
        )

    @property
    def queues(self) -> list[QueueName]:
        """The queues that a worker takes jobs from."""
        return [name for name in QUEUES if name in listed(self.takes)]


def listed(text: str) -> list[str]:
    """Return the items of a setting that lists them, separated by commas."""
    return [item.strip() for item in text.split(",") if item.strip()]
