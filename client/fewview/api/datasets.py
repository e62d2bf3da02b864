"""Datasets: captures, stored."""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fewview.api.arrays import to_npz
from fewview.api.correction_forms import CorrectionsState, DatasetCorrections
from fewview.api.downloads import download
from fewview.api.forms import Dataset, form_in
from fewview.api.lifting import identifier
from fewview.api.operations import Driver, operation
from fewview.api.steps import Request, Steps, once, path
from fewview.api.stored import Stored, labels
from fewview.capture import Capture
from fewview.corrections import Correction, Place, as_sent
from fewview.errors import FewviewError

Source = Capture | ArrayLike | str | PathLike[str]
OF_FRAMES = ("keypoints", "confidence", "points3d", "times")
PART_BYTES = 32 * 1024 * 1024  # of a long capture, sent in one request
PART_FRAMES = 50_000


class Datasets(Stored[Driver, Dataset]):
    """``/datasets``; models fitted to a dataset outlive it."""

    _form = Dataset
    _plural = "datasets"

    @operation
    def create(
        self,
        capture: Source,
        *,
        name: str | None = None,
        fps: float | None = None,
        tags: Iterable[str] = (),
        metadata: Mapping[str, Any] | None = None,
    ) -> Steps[Dataset]:
        """Store a capture, in several requests if it is long.

        Parameters
        ----------
        capture
            A :class:`~fewview.Capture`, a file that :func:`fewview.read` reads, or keypoints
            (N, K, P, 2) in pixels, NaN where not observed.
        fps
            Frames per second, if frames follow each other and the capture has no rate: views
            that are out of step are then found.
        tags, metadata
            Words, and any JSON object, for finding the dataset.

        Raises
        ------
        FormatError
            The file cannot be read.
        InvalidRequest
            The capture cannot be used; ``errors`` have the reasons.
        """
        capture = to_capture(capture)
        fields = labels(tags, metadata) | {
            "fps": fps or capture.fps,
            "image_sizes": capture.image_sizes,
            "calibration": capture.calibration and asdict(capture.calibration),
        }
        form = {key: json.dumps(value) for key, value in fields.items() if value is not None}
        if name is not None:
            form["name"] = name
        first, *others = parts(capture)
        request = Request(
            "POST",
            "/datasets",
            form_in(Dataset),
            headers=once(),
            body={"data": form, "files": {"file": ("capture.npz", to_npz(first))}},
        )
        dataset = yield from self._call(request)
        try:
            for part in others:
                dataset = yield from self._call(_append(dataset.id, part))
        except FewviewError:
            yield from self._call(self._delete(dataset.id))
            raise
        return dataset

    @operation
    def append(self, dataset: Dataset | str, capture: Source) -> Steps[Dataset]:
        """Add frames to the end of a dataset; fits made earlier do not see them.

        Raises
        ------
        InvalidRequest
            They have other views or keypoints.
        """
        for part in parts(to_capture(capture)):
            described = yield from self._call(_append(identifier(dataset), part))
        return described

    @operation
    def corrections(self, dataset: Dataset | str) -> Steps[DatasetCorrections]:
        """Return the keypoints of a dataset that were corrected or removed.

        Raises
        ------
        NotFound
            There is no such dataset.
        """
        where = path("datasets", identifier(dataset), "corrections")
        return self._call(Request("GET", where, form_in(DatasetCorrections)))

    @operation
    def correct(
        self,
        dataset: Dataset | str,
        corrections: Iterable[Correction] = (),
        *,
        undo: Iterable[Place] = (),
        dry_run: bool = False,
    ) -> Steps[CorrectionsState]:
        """Correct or remove keypoints, and undo earlier corrections; all or nothing.

        What was detected is kept. Fits and lifts that are made from now on see the corrections.

        Parameters
        ----------
        corrections
            They replace earlier ones of the same keypoints in the same frames.
        undo
            Keypoints that are again as they were detected; corrections will do.
        dry_run
            Check them, and change nothing.

        Raises
        ------
        FormatError
            A name is none of the dataset's views or keypoints.
        InvalidRequest
            A frame, view or keypoint is not in the dataset, or a position is far from the image.
        """
        corrected, undone = list(corrections), list(undo)
        views = names = None
        if any(isinstance(n, str) for p in (*corrected, *undone) for n in (p.view, p.keypoint)):
            known = (yield from self._call(self._get(identifier(dataset)))).raw
            views, names = known["view_names"], (known["skeleton"] or {}).get("keypoint_names")
        body = {
            "correct": [as_sent(each, views, names) for each in corrected],
            "undo": [
                as_sent(Place(each.frame, each.view, each.keypoint), views, names)
                for each in undone
            ],
        }
        request = Request(
            "PATCH",
            path("datasets", identifier(dataset), "corrections"),
            form_in(CorrectionsState),
            params={"dry_run": dry_run or None},
            body={"json": body},
        )
        return (yield from self._call(request))

    @operation
    def download(
        self, dataset: Dataset | str, file: str | PathLike[str], *, corrected: bool = True
    ) -> Steps[Path]:
        """Download a dataset's capture into an npz file; what broke off goes on where it was.

        It holds what was uploaded, to the last bit, but for keypoints that were corrected since,
        unless ``corrected`` is false: :func:`fewview.read` reads it.

        Raises
        ------
        NotFound
            There is no such dataset.
        """
        where = path("datasets", identifier(dataset), "capture")
        query = {} if corrected else {"corrected": "false"}
        return download(where, Path(file), self._patience, **query)


def to_capture(source: Source) -> Capture:
    """Return the capture that is given, in a file, or of these keypoints."""
    if isinstance(source, Capture):
        return source
    if isinstance(source, str | PathLike):
        from fewview.readers import read  # noqa: PLC0415 (not needed elsewhere)

        return read(source)
    return Capture(np.asarray(source, np.float32))


def parts(capture: Capture) -> Iterator[dict[str, NDArray[Any]]]:
    """Cut a capture's arrays into parts of a size to send; the first also describes it."""
    arrays = capture.arrays()
    # The form has the first two; the service keeps no numbers, but times.
    for name in ("image_sizes", "fps", "frame_numbers"):
        arrays.pop(name, None)
    framed = {name: arrays.pop(name) for name in OF_FRAMES if name in arrays}
    bytes_each = sum(array.nbytes for array in framed.values()) // max(1, capture.frames)
    length = min(PART_FRAMES, max(1, PART_BYTES // max(1, bytes_each)))
    for start in range(0, max(1, capture.frames), length):
        yield arrays | {name: array[start : start + length] for name, array in framed.items()}
        arrays = {}


def _append(dataset_id: str, part: dict[str, NDArray[Any]]) -> Request[Dataset]:
    return Request(
        "POST",
        path("datasets", dataset_id, "frames"),
        form_in(Dataset),
        headers={**once(), "Content-Type": "application/octet-stream"},
        body={"content": to_npz({key: part[key] for key in OF_FRAMES if key in part})},
    )
