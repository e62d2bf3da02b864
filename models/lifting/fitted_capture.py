"""Properties of the capture that a prior was fitted to, as far as its lifts need them."""

import json
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import orjson
from numpy.typing import NDArray
from pydantic import TypeAdapter

from models.capture.clocks import Clocks
from models.capture.frozen import at_places
from models.causes.cause import CAUSES, Cause, mended, suit
from models.findings.finding import Finding
from models.network.answers import Usual, nothing_unusual
from models.numerics.tensor_files import WeightsError
from models.settings.keypoints import MAX_KEYPOINTS, MAX_VIEWS

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

FINDINGS = TypeAdapter(tuple[Finding, ...])


class FittedCapture(NamedTuple):
    """What a fit found in its keypoints besides the prior.

    A prior has only the Q of P keypoints that have a place (`models.capture.checks.placed`). The
    others stay NaN in its lifts.
    """

    views: int  # 0 if it is not known how many there were
    known: Bool  # (P,) whether the keypoint has a place; Q of them
    places: Float32  # (M, 4) view, keypoint, x, y of pixels where a keypoint was frozen
    usual: Usual
    findings: tuple[Finding, ...]  # of the keypoints alone
    clocks: Clocks | None = None  # of views that were shifted in time
    # (Q, 3) where keypoints usually lie (`models.lifting.usual_structure`); (0, 3) if not known
    structure: Float32 = np.empty((0, 3), np.float32)
    mends: tuple[Cause, ...] = ()  # that the fit undid, in their order

    @property
    def whole(self) -> bool:
        """Whether every keypoint of a frame is an observation of one that the prior has."""
        return bool(self.known.all()) and not len(self.places) and not self.mends

    def observations(
        self, pixels: Float32, confidence: Float32 | None, views: Sequence[int] | None
    ) -> tuple[Float32, Float32 | None]:
        """Return pixels (N, K, Q, 2) and confidence (N, K, Q) of the known keypoints, mended.

        A keypoint at a pixel where it was frozen in the fit is NaN. `views` are those of the fit;
        without them all in their order, if the numbers agree.
        """
        if views is None and pixels.shape[1] == self.views:
            views = range(self.views)
        if views is not None:
            pixels, confidence, _ = mended(pixels, confidence, None, self.mends, views)
        if views is not None and len(self.places):
            stuck = at_places(pixels, self.places, views)
            pixels = np.where(stuck[..., None], np.float32(np.nan), pixels)
        return (
            pixels[:, :, self.known],
            None if confidence is None else confidence[:, :, self.known],
        )

    def clocks_of(self, views: Sequence[int] | None, count: int) -> Clocks | None:
        """Return the clocks of `views` of the fit, or of all if they are as many; None if unknown.

        `count` is the number of views without `views`.
        """
        if self.clocks is None or (views is None and count != self.views):
            return None
        return self.clocks if views is None else self.clocks.of_views(views)

    def check_views(self, learnt: Iterable[int]) -> None:
        """Raise `WeightsError` unless all counts of views agree; 0 is no count."""
        counts = {count for count in (self.views, *learnt) if count}
        if len(counts) > 1 or any(count > MAX_VIEWS for count in counts):
            raise WeightsError(f"the file contradicts itself about the views: {sorted(counts)}")

    def to_header(self) -> dict[str, str]:
        """Return it as strings, for the header of a file."""
        about = {
            "views": str(self.views),
            "known": "".join("01"[known] for known in self.known.tolist()),
            "places": json.dumps(self.places.tolist()),
            "usual": json.dumps([self.usual.misfits.tolist(), *self.usual[1:]]),
            "findings": FINDINGS.dump_json(self.findings).decode(),
            "structure": orjson.dumps(self.structure, option=orjson.OPT_SERIALIZE_NUMPY).decode(),
        }
        if self.clocks is not None:
            about["clocks"] = json.dumps([array.tolist() for array in self.clocks])
        if self.mends:
            about["mends"] = CAUSES.dump_json(self.mends).decode()
        return about

    @classmethod
    def from_header(cls, about: dict[str, str], keypoints: int) -> "FittedCapture":
        """Read the strings that `to_header` returned; without any, assume a whole capture.

        `keypoints` is Q. Raises `WeightsError` when they are not what `to_header` writes.
        """
        if "known" not in about:
            return whole_capture(keypoints)
        try:
            views = int(about["views"])
            known = np.array([{"0": False, "1": True}[flag] for flag in about["known"]])
            places = np.array(json.loads(about["places"]), np.float32).reshape(-1, 4)
            misfits, least, most = json.loads(about["usual"])
            usual = Usual(np.array(misfits, np.float64).reshape(-1), float(least), float(most))
            findings = FINDINGS.validate_json(about["findings"])
            structure = np.array(json.loads(about.get("structure", "[]")), np.float32)
            clocks = None
            if "clocks" in about:
                moments, offsets = (np.array(a, np.float64) for a in json.loads(about["clocks"]))
                clocks = Clocks(moments, offsets)
            mends = CAUSES.validate_json(about.get("mends", "[]"))
        except (ArithmeticError, LookupError, TypeError, ValueError, RecursionError) as error:
            raise WeightsError("the header does not describe the keypoints") from error
        consistent = (
            known.sum() == keypoints
            and len(known) <= MAX_KEYPOINTS
            and 0 <= views <= MAX_VIEWS
            and _is_usual(usual)
            and bool(np.isfinite(places).all())
            and bool((places[:, :2] >= 0).all() and (places[:, 1] < len(known)).all())
            and bool((places[:, 0] < views).all())
            and (clocks is None or clocks.suit(views))
            and structure.shape in ((0,), (0, 3), (keypoints, 3))
            and not np.isinf(structure).any()
            and suit(mends, views, len(known))
        )
        if not consistent:
            raise WeightsError("the header contradicts itself about the keypoints")
        structure = structure.reshape(-1, 3)
        return cls(views, known, places, usual, findings, clocks, structure, mends)


def _is_usual(usual: Usual) -> bool:
    """Whether the limits are valid; infinity is a limit that no frame exceeds."""
    return (
        0 < len(usual.misfits) <= MAX_VIEWS
        and bool((usual.misfits >= 0).all())  # NaN is not
        and 0 <= usual.least_size <= usual.most_size
        and usual.least_size < math.inf
    )


def whole_capture(keypoints: int) -> FittedCapture:
    """Return the capture of a file of an older version, whose prior has all keypoints."""
    known, places = np.ones(keypoints, np.bool_), np.empty((0, 4), np.float32)
    return FittedCapture(0, known, places, nothing_unusual(), ())
