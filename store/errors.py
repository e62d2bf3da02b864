"""What can go wrong in the store, in terms its callers can act on.

StoreError
├── NotFoundError          no such dataset, fit, model or lift
├── ConflictError          the record's state does not allow it
├── InputError             names the field at fault
│   ├── CaptureError       arrays that are no capture
│   ├── ConfigError        a configuration that its dataset does not allow
│   ├── SourceError        a model that a fit of its dataset cannot start from
│   └── LiftError          a dataset, or views of it, that the model cannot lift
├── DamagedError           a stored object is not what was stored
├── DeploymentError        records and objects that do not belong together
├── QueueFullError         as many fits, or lifts, wait as may
├── QuotaError             a key has taken all that it may
├── ShareError             a key, or its project, has its share of what all have together
├── KeyReusedError         an idempotency key came back with another request
└── LeaseLostError         a stale attempt tried to write; its work belongs to another by now
"""


class StoreError(Exception):
    """Base of the store's errors."""


class DamagedError(StoreError):
    """A stored object is not what was stored, or is gone although a record points to it."""

    def __init__(self, key: str) -> None:
        super().__init__(
            f"The stored object {key} is damaged: it is not what was written. Restore it from a "
            "backup, or delete what it belongs to."
        )
        self.key = key


class DeploymentError(StoreError):
    """Records and objects do not belong together: nothing may be served or deleted."""


KINDS = {
    "ds": "dataset",
    "fit": "fit",
    "mdl": "model",
    "lift": "lift",
    "key": "key",
    "wh": "webhook",
}  # by their identifiers


class NotFoundError(StoreError):
    """No record of this kind has this identifier."""

    def __init__(self, kind: str, identifier: str) -> None:
        other = KINDS.get(identifier.partition("_")[0])
        begin = next((f"{prefix}_" for prefix, known in KINDS.items() if known == kind), "")
        if other == kind:
            why = "it may have been deleted"
        elif "@" in identifier:
            why = "no alias of this name points to one"
        elif other is not None:
            why = f"this is the identifier of a {other}"
        else:
            why = f"identifiers begin with {begin}"
        super().__init__(f"There is no {kind} {identifier!r}; {why}.")
        self.kind = kind
        self.identifier = identifier


class ConflictError(StoreError):
    """The record exists, but its state does not allow what was asked."""


class InputError(StoreError):
    """One field of what came is at fault.

    Parameters
    ----------
    field
        As the caller named it: ``keypoints``, ``confidence``, ``calibration``, ...
    message
        What was expected, what came, and how to mend it.
    """

    def __init__(self, field: str, message: str) -> None:
        super().__init__(message)
        self.field = field


class CaptureError(InputError):
    """Arrays that do not make a capture."""


class ConfigError(InputError):
    """A fit's configuration names views or keypoints that its dataset does not have."""


class SourceError(InputError):
    """A model that a fit of a dataset cannot start from."""


class LiftError(InputError):
    """A lift of a dataset that its model cannot lift so."""


class QueueFullError(StoreError):
    """As many jobs of a kind wait as may."""

    def __init__(self, kind: str, limit: int) -> None:
        super().__init__(f"{limit} {kind}s are waiting already.")
        self.kind = kind


class QuotaError(StoreError):
    """A key has taken all that it may."""


class ShareError(StoreError):
    """A key, or its project, has its share of what all have together."""


class KeyReusedError(StoreError):
    """An idempotency key was used before with a different request."""


class LeaseLostError(StoreError):
    """The work is no longer this attempt's: it was cancelled, finished or taken over."""


def in_words(error: BaseException) -> str:
    """Return the first line of an error; what libraries add is for their authors."""
    line = str(getattr(error, "orig", None) or error).strip().partition("\n")[0]
    return line or type(error).__name__
