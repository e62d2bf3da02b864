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
    digest: str  # of the keypoints and of what the fit was told
    dataset_id: str | None = None
    fit_id: str | None = None

    @classmethod
    def of(cls, file: Path, digest: str) -> Self:
        """Read the notes of an earlier run of the very same; else begin new ones."""
        try:
            said = json.loads(file.read_text())
            notes = cls(file, str(said["digest"]), said["dataset_id"], said["fit_id"])
        except (OSError, ValueError, KeyError, TypeError):
            return cls(file, digest)
        return notes if notes.digest == digest else cls(file, digest)

    def keep(self) -> None:
        """Write the notes; the file is whole or the one before."""
        said = {"digest": self.digest, "dataset_id": self.dataset_id, "fit_id": self.fit_id}
        part = self.file.with_name(f".{self.file.name}.part")
        part.write_text(json.dumps(said))
        part.replace(self.file)


def digest_of(capture: Capture, *told: object) -> str:
    """Return a digest of all arrays of a capture and of what else decides the result."""
    digest = hashlib.sha256(json.dumps(told, default=str, sort_keys=True).encode())
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
) -> Fit:
    """Upload, fit and wait, as far as that is not done yet.

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
        return client.fits.wait(notes.fit_id, on_progress=on_progress)
    except JobFailed:
        notes.fit_id = None  # the same command tries anew
        notes.keep()
        raise


def described_by(client: Client, fit: Fit) -> Capture:
    """Return a capture without frames that says what the service knows of a fit's."""
    model = client.models.get(str(fit.model_id))
    skeleton, views = model.skeleton or {}, model.views or 0
    names, said = skeleton.get("keypoint_names"), _dataset(client, fit)
    cameras, sizes = said.get("view_names"), said.get("image_sizes")
    return Capture(
        keypoints=np.empty((0, views, model.keypoints, 2), np.float32),
        keypoint_names=names and tuple(names),
        edges=tuple((first, second) for first, second in skeleton.get("edges") or ()),
        view_names=tuple(cameras or (f"view{view}" for view in range(views))),
        image_sizes=sizes and tuple(size and (size[0], size[1]) for size in sizes),
        times=_times(client, fit) if said.get("has_times") else None,
        fps=said.get("fps"),
    )


def _dataset(client: Client, fit: Fit) -> dict[str, Any]:
    """Return what is said of a fit's dataset, nothing if it is gone."""
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
    """Write all that came of a fit into a folder, scaled to the body's height if that is told.

    Returns
    -------
    dict
        What goes into JSON: ``model``, ``files``, ``arrangement``, ``frames``, ``in_room``,
        ``reprojection_error`` (pixels, mean), ``findings`` and ``notes``.
    """
    assert fit.model_id is not None  # noqa: S101 (it has succeeded)
    lift = client.fits.reconstruction(fit)
    found = client.models.cameras(fit.model_id)
    room, said = room_of(lift, found, capture)
    unit, doubted = _unit_used(fit, unit, height)
    said += doubted
    if height is not None:
        if room is None:
            raise ValueError(f"--height: {'; '.join(said)}")
        room = scaled_to(room, height, capture.keypoint_names)
        said, unit = [*said, room.notes[-1]], unit or "m"
    animation = animation_of(lift, room, capture, unit=unit)
    files = []
    for known in FORMATS:
        if known.name in formats:
            try:
                files.append(write(folder / f"animation{known.suffix}", animation, known.name))
            except FewviewError as error:
                said.append(f"no {known.name}: {error}")
    if room is not None:
        files += _calibrations(room, lift, capture, folder, said)
    files.append(client.models.download(fit.model_id, folder / WEIGHTS))
    return {
        "model": fit.model_id,
        "files": [str(file) for file in files],
        "arrangement": found.arrangement,
        "frames": len(lift),
        "in_room": 0 if room is None else len(lift) - room.missing,
        "reprojection_error": float(np.nanmean(lift.reprojection_errors)),
        "findings": [
            asdict(finding) | {"cameras": _called(finding.views, capture)}
            for finding in fit.findings
        ],
        "notes": said,
    }


def _called(views: Sequence[int], capture: Capture) -> list[str]:
    names = capture.view_names or tuple(f"view{view}" for view in range(capture.views))
    return [names[view] for view in views if view < len(names)]


def _unit_used(fit: Fit, unit: Unit | None, height: float | None) -> tuple[Unit | None, list[str]]:
    """Return the unit if something that was used gives it, and what is to be said of it."""
    config = fit.config or {}
    if unit is None or height is not None or config.get("known_length"):
        return unit, []
    cameras = config.get("calibration") or ()
    posed = {v for v, camera in enumerate(cameras) if camera and camera.get("translation")}
    refused = {view for each in fit.findings if _refuses_poses(each) for view in each.views}
    if len(posed - refused) > 1:
        return unit, []
    why = (
        "the keypoints contradict the poses of the calibration, which were not used"
        if posed
        else "the fit was given neither a length nor poses"
    )
    return None, [f"no unit: {why}"]


def _refuses_poses(finding: Finding) -> bool:
    """Whether told poses were not used, and not lenses alone."""
    told = finding.evidence
    of_lens_alone = "focal_ratio" in told and "degrees" not in told
    return finding.code == "calibration_disagrees" and bool(told["refused"]) and not of_lens_alone


def _calibrations(
    room: Room, lift: Lift, capture: Capture, folder: Path, said: list[str]
) -> list[Path]:
    """Write the cameras in every format that can say them; add to `said` which cannot, and why."""
    files = []
    try:
        cameras = room.cameras(lift, capture.view_names, capture.image_sizes)
    except ValueError as error:
        said.append(f"no {' and no '.join(CALIBRATIONS)}: {error}")
        return []
    for name in CALIBRATIONS:
        try:
            files.append(write_cameras(folder / name, cameras))
        except ValueError as error:
            said.append(f"no {name}: {error}")
    return files


def _is_there(ask: Callable[[], object]) -> bool:
    try:
        ask()
    except NotFound:
        return False
    return True
