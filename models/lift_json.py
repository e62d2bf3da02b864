"""The JSON form of a lift, written straight from its arrays: an object a frame."""

from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from models.fitted import CAMERA_MODELS, REASONS

_WEAK = (
    b'{"camera":"weak_perspective","rotation":[[%b]],"scale":%b,"translation":[%b],"focal":null,'
    b'"principal_point":null,"distortion":null,"reprojection_error":%b}'
)
_LENSED = (
    b'{"camera":"%b","rotation":[[%b]],"scale":%b,"translation":[%b],"focal":[%b],'
    b'"principal_point":[%b],"distortion":[%b],"reprojection_error":%b}'
)
_WEAK_ARRAYS = ("rotations", "scales", "translations", "reprojection_errors")
_LENSED_ARRAYS = (
    "rotations",
    "scales",
    "translations",
    "focals",
    "principal_points",
    "distortions",
    "reprojection_errors",
)
_ANSWERED = b'{"status":"ok","reason":null,"points3d":[[%b]],"views":[%b]}'
_UNANSWERED = b'{"status":"too_few_keypoints","reason":%b,"points3d":null,"views":[%%b]}' % (
    orjson.dumps(REASONS["too_few_keypoints"])
)


def frames_to_json(arrays: dict[str, NDArray[Any]]) -> list[bytes]:
    """Return each frame as the text of a JSON object.

    Numbers are written array by array and cut into frames and views as text, which takes a tenth
    of the time of making lists of them first.

    Parameters
    ----------
    arrays
        Those of a :class:`models.fitted.Lift` by name: ``points3d`` (N, P, 3) and what is known of
        the cameras, (N, K, ...); NaN, and -1 in ``camera_models``, where there is no answer.
    """
    points, models = arrays["points3d"], arrays["camera_models"]
    count = models.shape[1]
    views = [b"null"] * models.size
    for index, name in enumerate(CAMERA_MODELS):
        places = np.flatnonzero(models.ravel() == index)
        if not len(places):
            continue
        weak = name == "weak_perspective"
        found = {
            array: arrays[array].reshape(models.size, *arrays[array].shape[2:])[places]
            for array in (_WEAK_ARRAYS if weak else _LENSED_ARRAYS)
        }
        form = _WEAK
        if weak:
            found["translations"] = found["translations"][:, :2]
        else:
            form = _LENSED.replace(b"%b", name.encode(), 1)
        texts = zip(*map(_texts, found.values()), strict=True)
        for place, parts in zip(places.tolist(), texts, strict=True):
            views[place] = form % parts
    answered = np.isfinite(points).all(axis=(1, 2)).tolist()
    frames = []
    for n, structure in enumerate(_texts(points)):
        cameras = b",".join(views[n * count : (n + 1) * count])
        frames.append(_ANSWERED % (structure, cameras) if answered[n] else _UNANSWERED % cameras)
    return frames


def _texts(array: NDArray[np.float32]) -> list[bytes]:
    """Return the JSON of each item of an array, without its outermost brackets.

    Each number is the shortest that gives its float32 back.
    """
    text = orjson.dumps(np.ascontiguousarray(array), option=orjson.OPT_SERIALIZE_NUMPY)
    depth = array.ndim
    return text[depth:-depth].split(b"]" * (depth - 1) + b"," + b"[" * (depth - 1))
