"""Reports on fits, stored beside their reconstructions."""

from typing import NamedTuple

from store.database import Store
from store.errors import ConflictError
from store.lookup import lost
from store.records import FitRecord


class Report(NamedTuple):
    """What a fit may be relied on for."""

    words: str  # its verdict
    data: bytes  # JSON


def load_report(store: Store, fit: FitRecord) -> bytes:
    """Return the report on a fit (JSON).

    Raises as ``answers.load_reconstruction`` does, and ``ConflictError`` if there is none.
    """
    if fit.status != "succeeded":
        raise ConflictError(f"Fit {fit.id!r} is {fit.status}: only a fit that succeeded has one.")
    if fit.report_key is None:
        raise ConflictError(
            f"There is no report on fit {fit.id!r}: an older version fitted it, or it could not be"
            " made. Fit the dataset again to have one."
        )
    try:
        return store.objects.get(fit.report_key)
    except FileNotFoundError as error:
        raise lost(store, FitRecord, fit.id, error) from error
