"""The steps of ``fewview run``, each done once: what is done is noted in the output folder."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import numpy as np

from fewview.animation import Unit
from fewview.api.forms import Finding, Fit
from fewview.api.lifting import Lift
from fewview.calibration import write_cameras
from fewview.capture import Capture, Float64
from fewview.client import Client
from fewview.errors import FewviewError, JobFailed, NotFound
from fewview.height import scaled_to
from fewview.mended import mended_in_words
from fewview.products import animation_of, room_of
from fewview.room import Room
from fewview.writers import write
from fewview.writers.registry import FORMATS

NOTES = "run.json"
NOTES_AGAIN = "run-again.json"  # of a fit with cameras that were parted
CALIBRATIONS = ("cameras.toml", "cameras.yml")  # of Anipose, of OpenCV
WEIGHTS = "model.safetensors"


@dataclass
class Notes:
    """What of a run is done, by the identifiers of the service."""

    file: Path
    digest: str  # of the keypoints and of the fit's settings
    dataset_id: str | None = None
    fit_id: str | None = None

    @classmethod
    def of(cls, file: Path, digest: str) -> Self:
        """Read the notes of an earlier run with the same digest; else begin new ones."""
        try:
            recorded = json.loads(file.read_text())
            notes = cls(file, str(recorded["digest"]), recorded["dataset_id"], recorded["fit_id"])
        except (OSError, ValueError, KeyError, TypeError):
            return cls(file, digest)
        return notes if notes.digest == digest else cls(file, digest)

    def keep(self) -> None:
        """Write the notes; the file is replaced at once or not at all."""
        recorded = {"digest": self.digest, "dataset_id": self.dataset_id, "fit_id": self.fit_id}
        part = self.file.with_name(f".{self.file.name}.part")
        part.write_text(json.dumps(recorded))
        part.replace(self.file)


def digest_of(capture: Capture, *settings: object) -> str:
    """Return a digest of all arrays of a capture and of all settings that decide the result."""
    digest = hashlib.sha256(json.dumps(settings, default=str, sort_keys=True).encode())
    for name, array in sorted(capture.arrays().items()):
        digest.update(f"{name}{array.dtype}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def fitted(
    client: Client,
    capture: Capture,
    notes: Notes,
    *,
    name: str,
    config: Mapping[str, Any],
    on_progress: Callable[[Fit], object],
    on_first: Callable[[Fit], object] | None = None,
) -> Fit:
    """Upload, fit and wait, as far as that is not done yet; `on_first` has the first answer.

    Raises
    ------
    FewviewError
        The service cannot be reached or refuses, or the fit fails.
    """
    if notes.fit_id is not None and not _is_there(lambda: client.fits.get(str(notes.fit_id))):
        notes.fit_id = None
    if notes.fit_id is None:
        if notes.dataset_id is None or not _is_there(
            lambda: client.datasets.get(str(notes.dataset_id))
        ):
            notes.dataset_id = client.datasets.create(capture, name=name).id
            notes.keep()
        notes.fit_id = client.fits.create(notes.dataset_id, name=name, **config).id
        notes.keep()
    try:
        if on_first is not None:
            first = client.fits.wait_for_answer(notes.fit_id, on_progress=on_progress)
            if first.answer_stage == "geometry":
                on_first(first)
        return client.fits.wait(notes.fit_id, on_progress=on_progress)
    except JobFailed:
        notes.fit_id = None  # the same command tries anew
        notes.keep()
        raise


def described_by(client: Client, fit: Fit) -> Capture:
    """Return a capture without frames that describes the capture of a fit."""
    model = client.models.get(str(fit.model_id))
    skeleton, views = model.skeleton or {}, model.views or 0
    names, dataset = skeleton.get("keypoint_names"), _dataset(client, fit)
    cameras, sizes = dataset.get("view_names"), dataset.get("image_sizes")
    return Capture(
        keypoints=np.empty((0, views, model.keypoints, 2), np.float32),
        keypoint_names=names and tuple(names),
        edges=tuple((first, second) for first, second in skeleton.get("edges") or ()),
        view_names=tuple(cameras or (f"view{view}" for view in range(views))),
        image_sizes=sizes and tuple(size and (size[0], size[1]) for size in sizes),
        times=_times(client, fit) if dataset.get("has_times") else None,
        fps=dataset.get("fps"),
    )


def _dataset(client: Client, fit: Fit) -> dict[str, Any]:
    """Return the JSON object of a fit's dataset, an empty one if it was deleted."""
    try:
        return client.datasets.get(fit.dataset_id).raw
    except NotFound:
        return {}


def _times(client: Client, fit: Fit) -> Float64:
    """Return the times (N,) or (N, K) of the frames of a fit's dataset."""
    with TemporaryDirectory() as folder:
        file = client.datasets.download(fit.dataset_id, Path(folder, "capture.npz"))
        with np.load(file, allow_pickle=False) as arrays:
            return np.asarray(arrays["times"], np.float64)


def export(
    client: Client,
    fit: Fit,
    capture: Capture,
    folder: Path,
    *,
    formats: Sequence[str],
    unit: Unit | None,
    height: float | None = None,
) -> dict[str, Any]:
    """Write all results of a fit into a folder, scaled to the body's height if it is given.

    Of a fit that goes on this is its first answer, which has no model.

    Returns
    -------
    dict
        The JSON output: ``model``, ``files``, ``arrangement``, ``frames``, ``in_room``,
        ``reprojection_error`` (pixels, mean), ``verdict``, ``findings`` and ``notes``.
    """
    lift = client.fits.reconstruction(fit)
    found = client.fits.cameras(fit)
    room, notes = room_of(lift, found, capture)
    mended = [mended_in_words(asdict(finding), capture.view_names) for finding in fit.findings]
    notes += [words for words in mended if words is not None]
    unit, doubted = _unit_used(fit, unit, height)
    notes += doubted
    if height is not None:
        if room is None:
            raise ValueError(f"--height: {'; '.join(notes)}")
        room = scaled_to(room, height, capture.keypoint_names)
        notes, unit = [*notes, room.notes[-1]], unit or "m"
    animation = animation_of(lift, room, capture, unit=unit)
    files = []
    for known in FORMATS:
        if known.name in formats:
            try:
                files.append(write(folder / f"animation{known.suffix}", animation, known.name))
            except FewviewError as error:
                notes.append(f"no {known.name}: {error}")
    if room is not None:
        files += _calibrations(room, lift, capture, folder, notes)
    if fit.model_id is not None:
        files.append(client.models.download(fit.model_id, folder / WEIGHTS))
    return {
        "model": fit.model_id,
        "files": [str(file) for file in files],
        "arrangement": found.arrangement,
        "frames": len(lift),
        "in_room": 0 if room is None else len(lift) - room.missing,
        "reprojection_error": float(np.nanmean(lift.reprojection_errors)),
        "verdict": fit.verdict and asdict(fit.verdict),
        "findings": [
            asdict(finding) | {"cameras": _called(finding.views, capture)}
            for finding in fit.findings
        ],
        "notes": notes,
    }


def _called(views: Sequence[int], capture: Capture) -> list[str]:
    names = capture.view_names or tuple(f"view{view}" for view in range(capture.views))
    return [names[view] for view in views if view < len(names)]


def _unit_used(fit: Fit, unit: Unit | None, height: float | None) -> tuple[Unit | None, list[str]]:
    """Return the unit if a given quantity that was used has it, and notes about it."""
    config, codes = fit.config or {}, {finding.code for finding in fit.findings}
    if unit is None or height is not None or config.get("known_length"):
        return unit, []
    distance = config.get("known_distance")
    if distance and codes.isdisjoint(("known_distance_not_used", "cameras_not_found")):
        return unit, []
    cameras = config.get("calibration") or ()
    posed = {v for v, camera in enumerate(cameras) if camera and camera.get("translation")}
    refused = {view for each in fit.findings if _refuses_poses(each) for view in each.views}
    if len(posed - refused) > 1:
        return unit, []
    why = (
        "the keypoints contradict the poses of the calibration, which were not used"
        if posed
        else "the known distance of two cameras was not used"
        if distance
        else "the fit was given neither a length nor poses"
    )
    return None, [f"no unit: {why}"]


def _refuses_poses(finding: Finding) -> bool:
    """Whether given poses were not used, and not only lenses."""
    evidence = finding.evidence
    of_lens_alone = "focal_ratio" in evidence and "degrees" not in evidence
    refused = finding.code == "calibration_disagrees" and bool(evidence["refused"])
    return refused and not of_lens_alone


def _calibrations(
    room: Room, lift: Lift, capture: Capture, folder: Path, notes: list[str]
) -> list[Path]:
    """Write the cameras in every format that can; add to `notes` why others cannot."""
    files = []
    try:
        cameras = room.cameras(lift, capture.view_names, capture.image_sizes)
    except ValueError as error:
        notes.append(f"no {' and no '.join(CALIBRATIONS)}: {error}")
        return []
    for name in CALIBRATIONS:
        try:
            files.append(write_cameras(folder / name, cameras))
        except ValueError as error:
            notes.append(f"no {name}: {error}")
    return files


def _is_there(ask: Callable[[], object]) -> bool:
    try:
        ask()
    except NotFound:
        return False
    return True
