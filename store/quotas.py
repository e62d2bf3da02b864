"""What a key may take of a deployment."""

from pydantic import BaseModel, ConfigDict, Field


class Quotas(BaseModel):
    """Bounds of a key; what is null has none."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    stored_bytes: int | None = Field(
        None,
        ge=0,
        le=2**60,
        description="Bytes of all that is kept of what was made with the key, records included: "
        "`GET /storage` shows what counts.",
    )
    queued_jobs: int | None = Field(
        None,
        ge=0,
        le=2**31,
        description="Fits and lifts made with the key that may wait at a time.",
    )
    requests_per_second: int | None = Field(None, ge=1, le=2**31)
    lifted_frames_per_second: int | None = Field(
        None, ge=1, le=2**31, description="Of `POST /lift` and streams."
    )

    def bound_records(self) -> bool:
        """Return whether there are bounds on what may be recorded."""
        return self.stored_bytes is not None or self.queued_jobs is not None
