"""The messages of a stream of frames: bytes of a fixed little-endian layout, and JSON.

``docs/streaming.md`` describes both.
"""

import json
import struct
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fewview.capture import Float32
from fewview.errors import ApiError, ConnectionFailed, api_error

FRAME, ANSWER = 1, 2
WITH_CONFIDENCE, WITH_TIME = 1, 2
LIFTED, CONTINUED = 1, 2
ALIGNED = 4  # bytes: the keypoints' part of an answer is padded to a multiple of this
HEADER, TIME = struct.Struct("<BBHI"), struct.Struct("<d")
QUALITY = struct.Struct("<fB3x")  # ends an answer
FLUSH = json.dumps({"flush": True})
VIEW = np.dtype(
    [
        ("camera_models", "<i4"),
        ("rotations", "<f4", (3, 3)),
        ("scales", "<f4"),
        ("translations", "<f4", (3,)),
        ("focals", "<f4", (2,)),
        ("principal_points", "<f4", (2,)),
        ("distortions", "<f4", (8,)),
        ("reprojection_errors", "<f4"),
    ]
)
# What follows in an answer, and its shape for each keypoint.
UNCERTAINTY: dict[str, dict[str, tuple[int, ...]]] = {
    "off": {},
    "sd": {"points3d_sd": ()},
    "full": {"points3d_sd": (), "points3d_covariance": (6,), "points3d_modes": (3, 12)},
}
STATUSES = {
    "malformed_body": 400,
    "not_found": 404,
    "idle": 408,
    "conflict": 409,
    "invalid_input": 422,
    "overloaded": 503,
    "unavailable": 503,
}


@dataclass(frozen=True)
class Ready:
    """The options as the service understood them; ``raw`` has all fields, also the limits."""

    model: str
    keypoints: int
    views: tuple[int, ...] | None
    refine: str
    uncertainty: str
    raw: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Answer:
    """One frame of K views in 3D, P keypoints; NaN where there is no answer.

    Attributes
    ----------
    sequence
        Of the frame that it answers.
    lifted, continued
        Whether there is a structure; whether its refinement started from the answer before.
    points3d
        (P, 3), in the frame of reference that the stream was asked for.
    views
        (K,) with the fields ``camera_models``, ``rotations`` (3, 3), ``scales``, ``translations``,
        ``focals``, ``principal_points``, ``distortions`` and ``reprojection_errors``, which mean
        what they mean in :class:`~fewview.Lift`.
    keypoints_seen
        (P,) how many views show each; 0 is inferred.
    outlier_probability
        (K, P) as in :class:`~fewview.Lift`.
    points3d_sd, points3d_covariance, points3d_modes
        (P,), (P, 6) and (P, 3, 12) as in :class:`~fewview.Lift`; None if the stream was not asked
        for them.
    quality, quality_reason
        How far the frame may be relied on, and why it is below 0.5, as in :class:`~fewview.Lift`;
        None where ``uncertainty`` is ``"off"``, and from older services.
    findings
        Sum of 1 ``rig_not_used``, 2 ``frame_unlike_fit``, 4 ``coordinates_of_another_scale``,
        8 ``not_in_room``.
    """

    sequence: int
    lifted: bool
    continued: bool
    points3d: Float32
    views: NDArray[np.void]
    keypoints_seen: NDArray[np.uint8]
    outlier_probability: Float32
    findings: int
    points3d_sd: Float32 | None = None
    points3d_covariance: Float32 | None = None
    points3d_modes: Float32 | None = None
    quality: float | None = None
    quality_reason: int | None = None


@dataclass(frozen=True)
class Dropped:
    """Frames that get no answer because newer ones took their places (``on_overload="latest"``)."""

    sequences: tuple[int, ...]


def write_frame(
    sequence: int, keypoints: ArrayLike, confidence: ArrayLike | None, time: float | None = None
) -> bytes:
    """Return a frame's message: ``keypoints`` (K, P, 2) pixels, ``confidence`` (K, P), seconds.

    Raises
    ------
    ValueError
        If they have not these shapes.
    """
    points = np.asarray(keypoints, "<f4")
    if points.ndim != 3 or points.shape[2] != 2:
        raise ValueError(f"expected keypoints of one frame, (views, keypoints, 2): {points.shape}")
    flags, moment, trailer = 0, b"", b""
    if time is not None:
        flags, moment = WITH_TIME, TIME.pack(time)
    if confidence is not None:
        weights = np.asarray(confidence, "<f4")
        if weights.shape != points.shape[:2]:
            raise ValueError(f"expected confidence {points.shape[:2]}, got {weights.shape}")
        flags, trailer = flags | WITH_CONFIDENCE, weights.tobytes()
    header = HEADER.pack(FRAME, flags, len(points), sequence)
    return b"".join((header, moment, points.tobytes(), trailer))


def read_message(message: str | bytes, keypoints: int, uncertainty: str) -> Answer | Dropped:
    """Return a message of the service after it was ready, with P ``keypoints`` for each view.

    It has as much of their uncertainty as the stream.

    Raises
    ------
    ApiError
        It is an error; ``errors`` have the reasons.
    """
    if isinstance(message, str):
        document = json.loads(message)
        if document["type"] == "dropped":
            return Dropped(tuple(document["sequences"]))
        raise refusal(document)
    _kind, flags, count, sequence = HEADER.unpack_from(message)
    points3d = np.frombuffer(message, "<f4", 3 * keypoints, HEADER.size).reshape(-1, 3)
    views = np.frombuffer(message, VIEW, count, HEADER.size + points3d.nbytes)
    seen_at = HEADER.size + points3d.nbytes + views.nbytes
    judged_at = seen_at + -(-keypoints // ALIGNED) * ALIGNED
    judged = np.frombuffer(message, "<f4", count * keypoints, judged_at)
    found, start = {}, judged_at + judged.nbytes
    for name, shape in UNCERTAINTY[uncertainty].items():
        array = np.frombuffer(message, "<f4", keypoints * prod(shape), start)
        found[name], start = array.reshape(keypoints, *shape), start + array.nbytes
    quality, reason = QUALITY.unpack_from(message, start) if len(message) > start else (None, None)
    return Answer(
        sequence=sequence,
        lifted=bool(flags & LIFTED),
        continued=bool(flags & CONTINUED),
        points3d=points3d,
        views=views,
        keypoints_seen=np.frombuffer(message, np.uint8, keypoints, seen_at),
        outlier_probability=judged.reshape(count, keypoints),
        findings=flags >> 2,
        quality=quality,
        quality_reason=reason,
        **found,
    )


def read_ready(message: str | bytes) -> Ready:
    """Return the service's first message.

    Raises
    ------
    ApiError
        It refused the stream.
    ConnectionFailed
        What answers is no Fewview.
    """
    document = json.loads(message) if isinstance(message, str) else {}
    if document.get("type") == "error":
        raise refusal(document)
    if document.get("type") != "ready":
        raise ConnectionFailed("expected a stream of Fewview, got something else: look at the URL")
    views = document["views"]
    return Ready(
        document["model"],
        document["keypoints"],
        None if views is None else tuple(views),
        document["refine"],
        document.get("uncertainty", "off"),  # older services send none
        document,
    )


def refusal(document: dict[str, Any]) -> ApiError:
    """Return the error in a message."""
    return api_error(STATUSES.get(document["code"], 500), {"title": document["code"], **document})
