"""What can go wrong in the store, in terms its callers can act on.

StoreError
├── NotFoundError          no such dataset, fit or model
├── ConflictError          the record's state does not allow it
├── CaptureError           arrays that are no capture; names the field
├── ConfigError            a configuration that its dataset does not allow; names the field
├── QueueFullError         as many fits wait as may
├── KeyReusedError         an idempotency key came back with another request
└── LeaseLostError         a stale attempt tried to write; another attempt owns the fit
"""


class StoreError(Exception):
    """Base of the store's errors."""


class NotFoundError(StoreError):
    """No record of this kind has this identifier."""

    def __init__(self, kind: str, identifier: str) -> None:
        super().__init__(f"There is no {kind} {identifier!r}; it may have been deleted.")
        self.kind = kind
        self.identifier = identifier


class ConflictError(StoreError):
    """The record exists, but its state does not allow what was asked."""


class CaptureError(StoreError):
    """Arrays that do not make a capture.

    Parameters
    ----------
    field
        The array at fault, as the caller named it: ``keypoints``, ``confidence``, ``points3d``, ...
    message
        What was expected, what came, and how to mend it.
    """

    def __init__(self, field: str, message: str) -> None:
        super().__init__(message)
        self.field = field


class ConfigError(StoreError):
    """A fit's configuration that speaks of views or keypoints which its dataset has not.

    Parameters
    ----------
    field
        The field of the configuration at fault: ``calibration``, ``known_length``, ...
    message
        What was expected, what came, and how to mend it.
    """

    def __init__(self, field: str, message: str) -> None:
        super().__init__(message)
        self.field = field


class QueueFullError(StoreError):
    """As many fits wait as may."""


class KeyReusedError(StoreError):
    """An idempotency key was used before with a different request."""


class LeaseLostError(StoreError):
    """The attempt no longer owns its fit, which was cancelled, finished or taken over."""
