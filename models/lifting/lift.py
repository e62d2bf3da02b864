"""What a lift returns."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from models.network.answers import Answers
from models.optics.lenses.projection import LENSES
from models.settings.keypoints import MIN_KEYPOINTS

# What `camera_models` are indices of: weak perspective, then the lenses in their order.
CAMERA_MODELS = ("weak_perspective", *(lens.LIFTED_AS for lens in LENSES))
Status = Literal["ok", "too_few_keypoints"]
REASONS: dict[Status, str] = {
    "ok": "",
    "too_few_keypoints": (
        f"no view shows {MIN_KEYPOINTS} keypoints or more that do not all lie at one place"
    ),
}


class Lift(Answers):
    """Structures and cameras of N frames of K views: the arrays of `Answers`, and their status."""

    __slots__ = ()

    @property
    def status(self) -> tuple[Status, ...]:
        """Whether each of the N frames has a structure: it has one if any view has a camera."""
        lifted = np.any(self.camera_models >= 0, axis=1).tolist()
        return tuple("ok" if one else "too_few_keypoints" for one in lifted)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why each frame has its status, in words; empty where it is ok."""
        return tuple(REASONS[status] for status in self.status)

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays under the names that they have in files and on the wire."""
        return {name: value for name, value in self._asdict().items() if name != "continued"}

    def frames(self, chosen: slice) -> "Lift":
        """Return some of the frames, as views of the arrays."""
        return Lift._make(array[chosen] for array in self)


def join(lifts: Sequence[Lift]) -> Lift:
    """Join lifts of the same views and keypoints, frame after frame."""
    return Lift._make(np.concatenate(parts) for parts in zip(*lifts, strict=True))
