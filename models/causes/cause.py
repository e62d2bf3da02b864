"""A cause: what was wrong with one view's pixels, and how it is undone."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from models.calibrating.image_sizes import ImageSizes
from models.causes.pixel_map import PixelMap
from models.findings.catalogue import CauseCode, Severity
from models.findings.finding import Finding

Float32 = NDArray[np.float32]

Kind = Literal[
    "cropped",  # counted from the corner of a window: `x`, `y` of it in the whole image, pixels
    "padded",  # shares of a square with black bars, stretched to the image: `fx_over_fy`
    "scaled",  # read on an image of another size: `scale` of it
    "stretched",  # of pixels that are not square: `fx_over_fy`; `bend` if the sides more so
    "mirrored",  # left is right
    "upside_down",  # turned by 180 degrees
    "on_its_side",  # turned by `degrees`, 90 or 270 clockwise
    "axes_exchanged",  # x is y
]
CODES: dict[Kind, CauseCode] = {
    "cropped": "view_cropped",
    "padded": "view_padded",
    "scaled": "view_scaled",
    "stretched": "view_stretched",
    "mirrored": "view_mirrored",
    "upside_down": "view_turned",
    "on_its_side": "view_turned",
    "axes_exchanged": "axes_exchanged",
}


class Cause(NamedTuple):
    """What was wrong with one view, with standard deviations of its numbers."""

    kind: Kind
    view: int
    numbers: dict[str, float]
    sds: dict[str, float]
    gain: float  # nats that the keypoints are likelier with it, and with others of its kind
    map: PixelMap  # that undoes it
    size: tuple[int, int] | None = None  # of the mended image; None if it is not known
    partners: tuple[int, ...] = ()  # (P,) which keypoint each changes places with; () if none does

    def finding(self, *, applied: bool) -> Finding:
        """Return the finding, with whether the fit has undone it."""
        evidence = dict(self.numbers)
        evidence |= {f"{name}_sd": sd for name, sd in self.sds.items()}
        evidence |= {"log_likelihood_ratio": self.gain, "applied": float(applied)}
        if self.partners:
            evidence["sides_exchanged"] = 1.0
        severity: Severity | None = "info" if applied else None
        found = Finding.of(CODES[self.kind], views=(self.view,), severity=severity)
        return found.with_evidence(evidence)


CAUSES = TypeAdapter(tuple[Cause, ...])


class Mended(NamedTuple):
    """Keypoints of K views as their cameras saw them."""

    keypoints: Float32  # (N, K, P, 2) pixels
    confidence: Float32 | None  # (N, K, P)
    image_sizes: ImageSizes | None


def mended(
    keypoints: Float32,
    confidence: Float32 | None,
    image_sizes: ImageSizes | None,
    causes: Sequence[Cause],
    views: Sequence[int] | None = None,
) -> Mended:
    """Undo causes in turn: map pixels (N, K, P, 2), exchange keypoints, replace sizes.

    `views` (K,) are the views of the fit that these are; None: all in their order.
    """
    keypoints = keypoints.copy() if causes else keypoints
    confidence = confidence.copy() if causes and confidence is not None else confidence
    sizes = None if image_sizes is None else list(image_sizes)
    for cause in causes:
        for place in _places(cause, views):
            keypoints[:, place] = cause.map.mended(keypoints[:, place])
            if cause.partners:
                partners = list(cause.partners)
                keypoints[:, place] = keypoints[:, place][:, partners]
                if confidence is not None:
                    confidence[:, place] = confidence[:, place][:, partners]
            if sizes is not None and cause.size is not None:
                sizes[place] = cause.size
    return Mended(keypoints, confidence, sizes)


def unmended(
    pixels: NDArray[np.float64], causes: Sequence[Cause], views: Sequence[int] | None = None
) -> NDArray[np.float64]:
    """Return pixels (N, K, P, 2), such as reprojections, as the user's images have them."""
    pixels = pixels.copy() if causes else pixels
    for cause in reversed(causes):
        for place in _places(cause, views):
            if cause.partners:  # its own inverse
                pixels[:, place] = pixels[:, place][:, list(cause.partners)]
            pixels[:, place] = cause.map.unmended(pixels[:, place])
    return pixels


def suit(causes: Sequence[Cause], views: int, keypoints: int) -> bool:
    """Whether these can be the causes of a capture of so many views and keypoints."""
    return all(
        0 <= cause.view < views
        and cause.map.valid
        and len(cause.partners) in (0, keypoints)
        and sorted(cause.partners) == list(range(len(cause.partners)))
        and all(cause.partners[partner] == k for k, partner in enumerate(cause.partners))
        for cause in causes
    )


def _places(cause: Cause, views: Sequence[int] | None) -> list[int]:
    """Return where the cause's view is among `views`, if it is."""
    if views is None:
        return [cause.view]
    return [place for place, view in enumerate(views) if view == cause.view]
