"""Reading a capture from an ``.npz`` file, and cutting it into what a fit sees and what not."""

import io
import zipfile
import zlib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

Array = NDArray[Any]
Float32 = NDArray[np.float32]

EXPECTED = (
    "expected an .npz file with `keypoints` (frames, views, keypoints, 2) in pixels, NaN where not "
    "observed; optionally `confidence` (frames, views, keypoints), `points3d` (frames, keypoints, "
    "3), `times` in seconds (frames,) or (frames, views), `fps`, `keypoint_names`, `edges` (n, 2), "
    "`image_sizes` (views, 2)"
)
USABLE_KEYPOINTS = 4  # a view that shows fewer has no camera


class CaptureError(Exception):
    """A file that is no capture; the message says what was expected, and what came."""


@dataclass(frozen=True)
class Capture:
    """N frames of K views of P keypoints."""

    keypoints: Float32  # (N, K, P, 2) pixels, NaN where not observed
    confidence: Float32 | None = None  # (N, K, P) in [0, 1]
    points3d: Float32 | None = None  # (N, P, 3) the truth, NaN where unknown
    times: Array | None = None  # (N,) or (N, K) seconds
    keypoint_names: Array | None = None  # (P,) of text
    edges: Array | None = None  # (n, 2) of integers: which keypoints are joined
    image_sizes: Array | None = None  # (K, 2) of integers: width and height in pixels

    def __len__(self) -> int:
        return len(self.keypoints)

    def frames(self, which: slice | NDArray[np.int64]) -> "Capture":
        """Return some of the frames, with everything else that the capture has."""
        return replace(
            self,
            keypoints=self.keypoints[which],
            confidence=None if self.confidence is None else self.confidence[which],
            points3d=None if self.points3d is None else self.points3d[which],
            times=None if self.times is None else self.times[which],
        )

    def observed(self) -> NDArray[np.bool_]:
        """Return which keypoints (N, K, P) were observed."""
        seen: NDArray[np.bool_] = np.all(np.isfinite(self.keypoints), axis=-1)
        return seen if self.confidence is None else seen & (self.confidence > 0)

    def npz(self, *names: str) -> bytes:
        """Return the arrays of these names, as far as there are any, as an npz file's bytes."""
        arrays = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        return buffer.getvalue()


def read_capture(path: Path) -> Capture:
    """Read an ``.npz`` file; arrays that are of no use here are left alone.

    Raises
    ------
    CaptureError
        If there is no such file, it is no ``.npz`` file, or its arrays do not fit together.
    """
    try:
        with path.open("rb") as file:
            return _checked(_read(file))
    except FileNotFoundError as error:
        raise CaptureError(f"there is no such file; {EXPECTED}") from error
    except OSError as error:
        raise CaptureError(f"{error.strerror or error}; {EXPECTED}") from error


def hold_out(capture: Capture, share: float, seed: int) -> tuple[Capture, Capture]:
    """Part a capture into the frames for the fit and those that it will not see.

    The unseen ones are drawn at random, at least one, from the frames that show enough for a
    lift. A capture with only one such frame is all for the fit: nothing could be learned without.
    """
    usable = np.flatnonzero((capture.observed().sum(-1) >= USABLE_KEYPOINTS).any(-1))
    count = max(1, round(share * len(usable))) if len(usable) > 1 else 0
    unseen = np.sort(np.random.default_rng(seed).choice(usable, count, replace=False))
    seen = np.setdiff1d(np.arange(len(capture)), unseen)
    return capture.frames(seen), capture.frames(unseen)


def _read(file: IO[bytes]) -> dict[str, Array]:
    """Read the arrays of a capture; nothing is ever unpickled."""
    try:
        loaded = np.load(file, allow_pickle=False)
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise CaptureError(f"this is no .npz file; {EXPECTED}") from error
    if not isinstance(loaded, NpzFile):
        raise CaptureError(f"this is a single array; {EXPECTED}")
    if "keypoints" not in loaded:
        came = ", ".join(loaded.files) or "no arrays"
        raise CaptureError(f"the file holds {came}; {EXPECTED}")
    found = {}
    known = [*(field.name for field in fields(Capture)), "fps"]
    for name in (name for name in known if name in loaded):
        try:
            found[name] = loaded[name]
        except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise CaptureError(f"`{name}` cannot be read ({error}); {EXPECTED}") from error
    return found


def _checked(found: dict[str, Array]) -> Capture:
    """Check that the arrays fit together; the service checks the numbers in them."""
    keypoints = found["keypoints"]
    if keypoints.dtype.kind not in "fiu" or keypoints.ndim != 4 or keypoints.shape[-1] != 2:
        raise CaptureError(
            f"`keypoints` is {keypoints.dtype} of shape {keypoints.shape}; {EXPECTED}"
        )
    n, k, p, _ = keypoints.shape
    for name, kinds, shape in (
        ("confidence", "fiu", (n, k, p)),
        ("points3d", "fiu", (n, p, 3)),
        ("times", "fiu", (n, k)[: found["times"].ndim] if "times" in found else ()),
        ("keypoint_names", "U", (p,)),
        ("edges", "iu", (None, 2)),
        ("image_sizes", "iu", (k, 2)),
    ):
        if name not in found:
            continue
        array = found[name]
        fits = len(array.shape) == len(shape) and all(
            size in (None, came) for size, came in zip(shape, array.shape, strict=True)
        )
        if array.dtype.kind not in kinds or not fits:
            sizes = ", ".join("any" if size is None else str(size) for size in shape)
            raise CaptureError(
                f"`{name}` is {array.dtype} of shape {array.shape}, where the {n} frames, {k} "
                f"views and {p} keypoints of `keypoints` ask for ({sizes}); {EXPECTED}"
            )
    fps = found.pop("fps", None)
    if fps is not None:
        if fps.dtype.kind not in "fiu" or fps.size != 1 or not fps.item() > 0:
            raise CaptureError(f"`fps` is {fps!r}, expected a number above 0; {EXPECTED}")
        # Once frames are left out, what remains has times, but no frames per second.
        found.setdefault("times", np.arange(n) / fps.item())
    for name in ("keypoints", "confidence", "points3d"):
        if name in found:
            found[name] = found[name].astype(np.float32)
    return Capture(**found)
