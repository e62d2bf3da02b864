"""Changes of what is known of a dataset besides its frames, and what follows from them."""

from collections.abc import Mapping
from functools import partial
from typing import Any

from sqlalchemy import update

from models.settings.times import check_rate
from store import dataset_findings
from store.database import Store
from store.datasets import load_frames
from store.errors import CaptureError
from store.lookup import get, lock, put
from store.records import DatasetRecord, ModelRecord

RATE_FRAMES = 1000  # plenty for the median of the steps between times


def change(
    store: Store, kind: type[DatasetRecord], identifier: str, columns: Mapping[str, Any]
) -> DatasetRecord:
    """Have columns of a dataset hold something else, and return it.

    Other image sizes are compared with the keypoints, for the findings. The models that were
    fitted to the dataset get its skeleton, too: names and edges change no figure of theirs.
    Parameters are those of `store.lookup.change`.

    Raises
    ------
    NotFoundError
        If there is no such dataset.
    CaptureError
        If its frames have times of another rate than ``fps``.
    """
    changed = False
    while not changed:
        dataset = get(store, kind, identifier)
        if columns.get("fps") is not None:
            _check_rate(store, dataset, columns["fps"])
        with_findings = dict(columns)  # which are too slow for a transaction
        if "image_sizes" in columns and columns["image_sizes"] != dataset.image_sizes:
            read = partial(load_frames, store, dataset.id)
            sizes = columns["image_sizes"]
            with_findings["findings"] = dataset_findings.of_sizes(read, dataset, sizes)
        with store.writing() as session:
            record = lock(session, kind, identifier)
            changed = record.checksum == dataset.checksum  # else frames were added meanwhile
            if changed:
                put(session, record, with_findings)
            if changed and "skeleton" in columns:
                mine = ModelRecord.dataset_id == dataset.id
                session.execute(update(ModelRecord).where(mine).values(skeleton=record.skeleton))
    return record


def _check_rate(store: Store, dataset: DatasetRecord, fps: float) -> None:
    if dataset.last_times is None:
        return
    times = load_frames(store, dataset.id, 0, min(dataset.frames, RATE_FRAMES)).times
    if times is None:
        return
    try:
        check_rate(fps, times)
    except ValueError as error:
        raise CaptureError("fps", str(error)) from error
