"""Changes of what is known of a dataset besides its frames, and what follows from them.

Corrections of keypoints are such a change, too: the frames stay what they are.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from sqlalchemy import update
from sqlalchemy.orm import undefer

from models.settings.times import check_rate
from store import corrections, dataset_findings
from store.corrections import Corrections, Place
from store.database import Store
from store.datasets import load_frames
from store.errors import CaptureError, NotFoundError
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
            changed = corrections.same_keypoints(record, dataset)
            if changed:
                put(session, record, with_findings)
            if changed and "skeleton" in columns:
                mine = ModelRecord.dataset_id == dataset.id
                session.execute(update(ModelRecord).where(mine).values(skeleton=record.skeleton))
    return record


def correct(
    store: Store,
    dataset_id: str,
    corrected: Corrections,
    undone: Sequence[Place] = (),
    *,
    dry_run: bool = False,
) -> DatasetRecord:
    """Put corrections into a dataset, undo others, and return it; what is undone already stays so.

    Its findings are looked for anew. With ``dry_run`` nothing is stored, and the record returned
    has the corrections that it would have.

    Raises
    ------
    NotFoundError
        If there is no such dataset.
    InputError
        If a place is not in it, a position is far from its image, or there are too many.
    """
    changed = False
    while not changed:
        dataset, known = corrections_of(store, dataset_id)
        corrections.check(dataset, corrected, undone)
        after = list(corrections.merged(known, corrected, undone).values())
        columns = corrections.columns(after)
        if columns["corrections_checksum"] != dataset.corrections_checksum and not dry_run:
            read = partial(load_frames, store, dataset.id, corrected=after)
            columns["findings"] = dataset_findings.of_sizes(read, dataset, dataset.image_sizes)
        with store.writing() as session:
            record = lock(session, DatasetRecord, dataset_id)
            changed = corrections.same_keypoints(record, dataset)
            if changed and not dry_run:
                put(session, record, columns)
    if dry_run:
        record.corrections_count = columns["corrections_count"]
        record.corrections_checksum = columns["corrections_checksum"]
    return record


def corrections_of(store: Store, dataset_id: str) -> tuple[DatasetRecord, Corrections]:
    """Return a dataset and its corrections, which are of one moment.

    Raises ``NotFoundError`` if there is no such dataset.
    """
    with_them = [undefer(DatasetRecord.corrections)]  # one statement reads both
    with store.reading() as session:
        dataset = session.get(DatasetRecord, dataset_id, options=with_them)
    if dataset is None:
        raise NotFoundError(DatasetRecord.noun, dataset_id)
    return dataset, corrections.in_rows(dataset.corrections)


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
