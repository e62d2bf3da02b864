"""A lift as JSON, one object for each frame."""

from collections.abc import Iterable
from itertools import repeat
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from models.lifting.lift import CAMERA_MODELS, FINDING_BITS, REASONS
from models.posterior.quality import REASONS as REASONS_OF_QUALITY
from models.settings.uncertainty import MODES, SYMMETRIC

Arrays = dict[str, NDArray[Any]]


def frames_to_json(arrays: Arrays) -> list[bytes]:
    """Return each frame as the text of a JSON object.

    Numbers are written array by array, and the text is then cut into frames and views. This takes
    a fraction of the time of making lists first. Each number has the fewest digits that give its
    float32 back.

    Parameters
    ----------
    arrays
        Those of `LiftedFrames.arrays`; NaN, and -1 in ``camera_models``, where there is no answer.
        Lifts of older versions have no ``keypoints_seen``, ``outlier_probability``,
        ``points3d_sd``, ``quality``, ``quality_reason`` and ``findings``. Objects have covariances
        and modes only if these are here.
    """
    models = arrays["camera_models"]
    views = np.full(models.shape, b"null", object)
    _write_views(views, np.equal(models, 0), arrays, _WEAK, _WEAK_ARRAYS)
    _write_views(views, np.greater(models, 0), arrays, _LENSED, _LENSED_ARRAYS)
    points = arrays["points3d"]
    known: NDArray[np.bool_] = np.isfinite(points[..., 0])
    answered: NDArray[np.bool_] = np.any(known, axis=1)
    texts = [b"[[%b]]" % text for text in _texts(points)]
    if not known.all():  # a keypoint that has no place in the fit
        texts = [text.replace(_NO_POINT, b"null") for text in texts]
    return [
        (_ANSWERED if fine else _NOT_IN_ROOM if b"not_in_room" in found else _UNANSWERED)
        % {
            b"points": text,
            b"sd": sd + full,
            b"seen": seen,
            b"odd": odd,
            b"quality": quality,
            b"why": why,
            b"findings": found,
            b"views": shown,
        }
        for fine, text, sd, full, seen, odd, quality, why, found, shown in zip(
            answered.tolist(),
            texts,
            _known(arrays, "points3d_sd"),
            _covariances(arrays),
            _seen(arrays),
            _known(arrays, "outlier_probability"),
            _known(arrays, "quality"),
            _by_place(arrays, "quality_reason", _REASONS, b"null"),
            _by_place(arrays, "findings", _CODES, b"[]"),
            map(b",".join, views.tolist()),
            strict=True,
        )
    ]


def _seen(arrays: Arrays) -> Iterable[bytes]:
    """Return the JSON of how many views saw each keypoint, for every frame."""
    if "keypoints_seen" not in arrays:
        return repeat(b"null", len(arrays["points3d"]))
    return [b"[%b]" % text for text in _texts(arrays["keypoints_seen"])]


def _known(arrays: Arrays, name: str, nothing: bytes = b"null") -> Iterable[bytes]:
    """Return the JSON of an array for every frame; null for frames of which it knows nothing.

    `nothing` is what is written of a point of which it knows nothing, and becomes null.
    """
    found = arrays.get(name)
    if found is None or np.isnan(found).all():
        return repeat(b"null", len(arrays["points3d"]))
    rows: list[bool] = np.any(np.isfinite(found), axis=tuple(range(1, found.ndim))).tolist()
    left, right = b"[" * (found.ndim - 1), b"]" * (found.ndim - 1)
    texts = [left + text + right for text in _texts(found)]
    if nothing != b"null":
        texts = [text.replace(nothing, b"null") for text in texts]
    return [text if known else b"null" for known, text in zip(rows, texts, strict=True)]


def _covariances(arrays: Arrays) -> Iterable[bytes]:
    """Return the members of every frame for covariances and modes, where the lift has these."""
    asked = [name for name in _OF_NO_POINT if name in arrays]
    if not asked:
        return repeat(b"", len(arrays["points3d"]))
    members = [
        [b',"%b":%b' % (name.encode(), text) for text in _known(arrays, name, _OF_NO_POINT[name])]
        for name in asked
    ]
    return map(b"".join, zip(*members, strict=True))


def _by_place(arrays: Arrays, name: str, texts: list[bytes], otherwise: bytes) -> Iterable[bytes]:
    """Return for every frame the text at the place that an array has of it."""
    if name not in arrays:
        return repeat(otherwise, len(arrays["points3d"]))
    return [texts[place] for place in arrays[name].tolist()]


def _write_views(
    views: NDArray[np.object_],
    chosen: NDArray[np.bool_],
    arrays: Arrays,
    form: bytes,
    names: tuple[str, ...],
) -> None:
    """Fill the ``form`` of a camera with the values of ``names``, for some views (N, K)."""
    if not chosen.any():
        return
    found = {name: arrays[name][chosen] for name in names}
    if form is _WEAK:
        found["translations"] = found["translations"][:, :2]
    cameras = [_CAMERAS[model] for model in arrays["camera_models"][chosen]]
    values = zip(cameras, *map(_texts, found.values()), strict=True)
    views[chosen] = [form % value for value in values]


def _texts(array: NDArray[Any]) -> list[bytes]:
    """Return the JSON of each item of an array, without its outermost brackets."""
    text = orjson.dumps(np.ascontiguousarray(array), option=orjson.OPT_SERIALIZE_NUMPY)
    depth = array.ndim
    return text[depth:-depth].split(b"]" * (depth - 1) + b"," + b"[" * (depth - 1))


_CAMERAS = [orjson.dumps(name) for name in CAMERA_MODELS]
_WEAK_ARRAYS = ("rotations", "scales", "translations", "reprojection_errors")
_WEAK = (
    b'{"camera":%b,"rotation":[[%b]],"scale":%b,"translation":[%b],"reprojection_error":%b,'
    b'"focal":null,"principal_point":null,"distortion":null}'
)
_LENSED_ARRAYS = (*_WEAK_ARRAYS, "focals", "principal_points", "distortions")
_LENSED = (
    b'{"camera":%b,"rotation":[[%b]],"scale":%b,"translation":[%b],"reprojection_error":%b,'
    b'"focal":[%b],"principal_point":[%b],"distortion":[%b]}'
)
_NO_POINT = b"[null,null,null]"
_OF_NO_POINT = {
    "points3d_covariance": orjson.dumps([None] * SYMMETRIC),
    "points3d_modes": orjson.dumps([[None] * MODES] * 3),
}
_CODES = [  # for every sum of bits
    orjson.dumps([code for bit, code in FINDING_BITS.items() if total & bit])
    for total in range(2 * max(FINDING_BITS))
]
_REASONS = [b"null", *(orjson.dumps(reason) for reason in REASONS_OF_QUALITY)]
_ANSWERED = (
    b'{"status":"ok","reason":null,"points3d":%(points)b,"points3d_sd":%(sd)b,"keypoints_seen":%(seen)b,'
    b'"outlier_probability":%(odd)b,"quality":%(quality)b,"quality_reason":%(why)b,'
    b'"views":[%(views)b],"findings":%(findings)b}'
)
_UNANSWERED, _NOT_IN_ROOM = (
    b'{"status":%b,"reason":%b,"points3d":null,"points3d_sd":%%(sd)b,"keypoints_seen":%%(seen)b,'
    b'"outlier_probability":%%(odd)b,"quality":%%(quality)b,"quality_reason":%%(why)b,'
    b'"views":[%%(views)b],"findings":%%(findings)b}'
    % (orjson.dumps(status), orjson.dumps(REASONS[status]))
    for status in ("too_few_keypoints", "not_in_room")
)
