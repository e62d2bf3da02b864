"""What is noticed of a capture's keypoints as it is stored, at a cost that is bounded."""

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import func, select

from models.capture.checks import ABSENCES, NUMBERS, absences, capture_findings, observed, sample
from models.findings.advice import FAULTS, noticed
from models.findings.finding import Finding, dumped
from store import corrections
from store.capture import Capture, concatenate
from store.database import Store
from store.errors import DamagedError
from store.records import Chunk, DatasetRecord

logger = logging.getLogger(__name__)

MOST_CHUNKS = 16  # that are looked at when frames are added


def of_new(capture: Capture, image_sizes: list[Any] | None) -> list[Any]:
    """Return the findings of a capture, as plain data; of a long one, from a sample of it."""
    _, views, keypoints, _ = capture.keypoints.shape
    numbers = sample(capture.frames, views, keypoints)
    found = _of_sample(_frames(capture, numbers), image_sizes, numbers, capture.frames)
    if len(numbers) == capture.frames:
        return dumped(found)
    return dumped(_with(_absences(capture, capture.frames), found))


def of_sizes(
    read: Callable[[int, int], Capture], dataset: DatasetRecord, image_sizes: list[Any] | None
) -> list[Any]:
    """Return the findings that a stored dataset has with other image sizes, as plain data.

    They are those of `of_new`: the same sample of frames is looked at, of which ``read`` returns
    those from one up to another. What no frame shows does not depend on the sizes.
    """
    numbers = sample(dataset.frames, dataset.views, dataset.keypoints)
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    part = concatenate([read(int(run[0]), int(run[-1]) + 1) for run in runs])
    found = _of_sample(part, image_sizes, numbers, dataset.frames)
    if len(numbers) == dataset.frames:
        return dumped(found)
    known = [Finding.model_validate(finding) for finding in dataset.findings or []]
    return dumped(_with([each for each in known if each.code in ABSENCES], found))


def of_longer(store: Store, dataset: DatasetRecord, added: Capture) -> list[Any]:
    """Return the findings of a dataset to whose end frames are added, as plain data.

    A few of its chunks are looked at, and the added frames. What no frame had shown before, and
    none of the added does, is still not shown.
    """
    size = max(1, NUMBERS // (dataset.views * dataset.keypoints) // (MOST_CHUNKS + 1))
    parts, numbers = [], []
    with store.reading() as session:
        corrected = corrections.of(session, DatasetRecord, dataset.id)
    for chunk in _some_chunks(store, dataset):
        part = slice(0, min(chunk.frames, size))
        try:
            found = Capture.frames_from(partial(store.objects.peek, chunk.key), part)
            parts.append(corrections.applied(found, corrected, chunk.first_frame))
        except FileNotFoundError:  # the dataset was deleted since: its findings are not needed
            continue
        except (DamagedError, *FAULTS):  # the jobs that need the chunk will fail
            logger.exception("Findings are made without the damaged chunk %s", chunk.key)
            continue
        numbers.append(np.arange(chunk.first_frame, chunk.first_frame + part.stop))
    last = np.arange(min(added.frames, size))
    parts.append(_frames(added, last))
    numbers.append(dataset.frames + last)
    frames, there = dataset.frames + added.frames, np.concatenate(numbers)
    findings = _of_sample(concatenate(parts), dataset.image_sizes, there, frames)
    if len(there) == frames:
        return dumped(findings)
    still = noticed(_still, dataset.findings or [], _absences(added, frames))
    return dumped(_with(still, findings))


def _of_sample(
    part: Capture, image_sizes: list[Any] | None, numbers: NDArray[np.int64], frames: int
) -> tuple[Finding, ...]:
    return capture_findings(
        part.keypoints, part.confidence, image_sizes, numbers=numbers, frames=frames
    )


def _absences(capture: Capture, frames: int) -> tuple[Finding, ...]:
    return noticed(absences, observed(capture.keypoints, capture.confidence), frames)


def _with(absent: Iterable[Finding], found: Sequence[Finding]) -> list[Finding]:
    """Return the findings of a sample, with those of absences checked against all frames."""
    return [*absent, *(finding for finding in found if finding.code not in ABSENCES)]


def _still(before: Sequence[Any], now: Sequence[Finding]) -> Iterator[Finding]:
    """Yield what is absent both from the frames before (plain data) and from those added."""
    known = [Finding.model_validate(finding) for finding in before]
    for finding in now:
        for earlier in known:
            if finding.code != earlier.code:
                continue
            views = tuple(sorted(set(earlier.views) & set(finding.views)))
            keypoints = tuple(sorted(set(earlier.keypoints) & set(finding.keypoints)))
            if views or keypoints or not (earlier.views or earlier.keypoints):
                yield finding.model_copy(update={"views": views, "keypoints": keypoints})


def _some_chunks(store: Store, dataset: DatasetRecord) -> list[Chunk]:
    """Return the chunks of a dataset, or some that are spread evenly over its frames."""
    mine = select(Chunk).where(Chunk.dataset_id == dataset.id)
    count = select(func.count()).select_from(mine.subquery())
    with store.reading() as session:
        if (session.scalar(count) or 0) <= MOST_CHUNKS:
            return list(session.scalars(mine.order_by(Chunk.first_frame)))
        found: dict[int, Chunk] = {}
        for place in range(MOST_CHUNKS):
            frame = place * dataset.frames // MOST_CHUNKS
            before = mine.where(Chunk.first_frame <= frame).order_by(Chunk.first_frame.desc())
            chunk = session.scalar(before.limit(1))
            if chunk is not None:
                found[chunk.first_frame] = chunk
        return list(found.values())


def _frames(capture: Capture, numbers: NDArray[np.int64]) -> Capture:
    if len(numbers) == capture.frames:
        return capture
    confidence = None if capture.confidence is None else capture.confidence[numbers]
    return Capture(capture.keypoints[numbers], confidence)
