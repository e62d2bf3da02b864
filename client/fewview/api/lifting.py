"""Lifting: keypoints to 3D at once (``POST /lift``), and lifts as arrays."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any, Self

import httpx2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fewview import measures
from fewview.api.arrays import SAFETENSORS, read_safetensors, to_safetensors
from fewview.api.forms import Finding, Model, read
from fewview.api.steps import Request
from fewview.capture import Capture, Float32
from fewview.measures import Measured


@dataclass(frozen=True, eq=False)
class Lift:
    """N frames of K views in 3D, P keypoints each; NaN where there is no answer.

    Attributes
    ----------
    points3d
        (N, P, 3) canonical structures, right-handed, in the unit given to the fit. With
        ``frame="room"``, points in the room; NaN in frames that have no place in it.
    points3d_sd
        (N, P) how far each point may be off: the root mean square of its expected distance from
        the true one, in the unit of the points. NaN where it is not known; None for old
        reconstructions, and with ``uncertainty="off"``.
    rotations
        (N, K, 3, 3) from there to each camera's axes: x right, y down, z forward.
    scales
        (N, K) pixels per unit.
    translations
        (N, K, 3): in perspective, units; in weak perspective (x, y) in pixels, and NaN. In a
        canonical frame the unit is that of the first view; if this view moves while others are
        static, the unit differs from frame to frame. In the room there is one unit.
    focals, principal_points
        (N, K, 2) pixels.
    distortions
        (N, K, 8) in OpenCV's order.
    reprojection_errors
        (N, K) pixels.
    keypoints_used
        (N, K) how many keypoints the view had.
    camera_models
        (N, K): -1 no camera, 0 weak perspective, 1 perspective, 2 fisheye.
    keypoints_seen
        (N, P) how many views show each; 0 is inferred. None for old reconstructions.
    outlier_probability
        (N, K, P) in [0, 1]: probability of a keypoint to be an outlier. Above 0.5 it was left out
        of the lift or, if left and right were swapped, used in its partner's place. NaN where it
        was not observed or not judged; None for old reconstructions.
    quality, quality_reason
        (N,) how far each frame may be relied on, in [0, 1], and why it is below 0.5: 1
        ``little_evidence``, 2 ``views_disagree``, 3 ``unlike_fit``, 4 ``no_evidence``, else 0. NaN
        where it is not known; None for old reconstructions.
    points3d_covariance, points3d_modes
        (N, P, 6) covariances C of the points, xx, xy, xz, yy, yz, zz, and (N, P, 3, 12) modes U:
        how points are off together. The covariance of all coordinates of a structure is
        blockdiag(C - U U^T) + U U^T. NaN where it is not known; None without
        ``uncertainty="full"``.
    frame_findings
        (N,) sums of 1 ``rig_not_used``, 2 ``frame_unlike_fit``, 4 ``coordinates_of_another_scale``,
        8 ``not_in_room``; None for old reconstructions.
    findings
        The same and others, with texts.
    model_id
        The model of the lift; None if it was deleted since.
    """

    points3d: Float32
    rotations: Float32
    scales: Float32
    translations: Float32
    focals: Float32
    principal_points: Float32
    distortions: Float32
    reprojection_errors: Float32
    keypoints_used: NDArray[np.integer[Any]]
    camera_models: NDArray[np.integer[Any]]
    points3d_sd: Float32 | None = None
    points3d_covariance: Float32 | None = None
    points3d_modes: Float32 | None = None
    keypoints_seen: NDArray[np.integer[Any]] | None = None
    outlier_probability: Float32 | None = None
    quality: Float32 | None = None
    quality_reason: NDArray[np.integer[Any]] | None = None
    frame_findings: NDArray[np.integer[Any]] | None = None
    findings: tuple[Finding, ...] = ()
    model_id: str | None = None

    def __len__(self) -> int:
        """Return the number of frames N."""
        return len(self.points3d)

    @property
    def lifted(self) -> NDArray[np.bool_]:
        """Which frames (N,) got a structure."""
        return np.asarray(np.isfinite(self.points3d).any(axis=(1, 2)))

    def lengths(self, pairs: ArrayLike) -> Measured:
        """Return the distances of pairs of keypoints in every frame, and how far they may be off.

        To have the deviations, lift with ``uncertainty="full"``. They are to first order, and know
        what points share: that they are off together by the scale, or by a camera. Each distance
        has one, not each point of its own. Without `full` they are NaN.

        Parameters
        ----------
        pairs
            (M, 2) keypoints, counted from 0.

        Returns
        -------
        Measured
            ``values`` and ``sds`` (N, M), in the unit of the points.

        Raises
        ------
        ValueError
            There are no such keypoints, or both of a pair are the same.

        Examples
        --------
        >>> lift = client.lift(model, keypoints, uncertainty="full")
        >>> values, sds = lift.lengths([(11, 13), (13, 15)])  # thigh and shin
        >>> f"{values[0, 0]:.3f} ± {sds[0, 0]:.3f}"
        """
        return measures.lengths(self._uncertain, pairs)

    def angles(self, triples: ArrayLike) -> Measured:
        """Return the angles at the second of three keypoints (M, 3), degrees; see :meth:`lengths`.

        To first order: near 0 and 180 degrees, where an angle has an end, a deviation that is as
        large as what is left to it is too small.
        """
        return measures.angles(self._uncertain, triples)

    def ratios(self, pairs: ArrayLike) -> Measured:
        """Return the length of the first of two pairs (M, 2, 2) divided by that of the second.

        Ratios of lengths know no unit, so neither does how far they may be off: it is without the
        scale's. See :meth:`lengths`.
        """
        return measures.ratios(self._uncertain, pairs)

    @property
    def _uncertain(self) -> measures.Uncertain:
        return measures.Uncertain(self.points3d, self.points3d_covariance, self.points3d_modes)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays by their names here, such as for ``np.savez``."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}

    @classmethod
    def of(cls, response: httpx2.Response) -> Self:
        """Read a response of safetensors."""
        arrays, about = read_safetensors(response.content)
        if "findings" in arrays:
            arrays["frame_findings"] = arrays.pop("findings")
        known = {item.name for item in fields(cls)}
        findings = json.loads(about.get("findings", "[]"))
        return cls(
            **{name: array for name, array in arrays.items() if name in known},
            findings=tuple(read(Finding, finding) for finding in findings),
            model_id=about.get("model") or about.get("model_id"),
        )


def lift_request(
    model: Model | str,
    keypoints: Capture | ArrayLike,
    *,
    confidence: ArrayLike | None = None,
    times: ArrayLike | None = None,
    refine: str | None = None,
    views: Iterable[int] | None = None,
    frame: str | None = None,
    up: ArrayLike | None = None,
    uncertainty: str | None = None,
) -> Request[Lift]:
    """Return the request that lifts frames with a fitted model.

    Parameters
    ----------
    keypoints
        (N, K, P, 2) pixels, NaN where not observed; or a capture.
    confidence
        (N, K, P) in [0, 1]; 0 is not observed.
    times
        (N,) or (N, K) seconds, rising, with which frames are smoothed in time.
    refine
        ``auto``, ``full`` or ``off``: where frames are refined in perspective. None: as in the fit.
    views
        Which K views of the fit these are; None if they are all, or unknown.
    frame, up
        The frame of reference of points and cameras; see :meth:`~fewview.Client.lift`.
    uncertainty
        ``off``, ``sd`` or ``full``; see :meth:`~fewview.Client.lift`.
    """
    if isinstance(keypoints, Capture):
        confidence = keypoints.confidence if confidence is None else confidence
        if times is None:
            times = keypoints.seconds()
        keypoints = keypoints.keypoints
    arrays: dict[str, NDArray[Any]] = {"keypoints": np.asarray(keypoints, np.float32)}
    if confidence is not None:
        arrays["confidence"] = np.asarray(confidence, np.float32)
    if times is not None:
        arrays["times"] = np.asarray(times, np.float64)
    return Request(
        "POST",
        "/lift",
        Lift.of,
        params={
            "model": identifier(model),
            "refine": refine,
            "views": None if views is None else tuple(views),
            "uncertainty": uncertainty,
            **room_query(frame, up),
        },
        headers={"Content-Type": SAFETENSORS, "Accept": SAFETENSORS},
        body={"content": to_safetensors(arrays)},
    )


def room_query(frame: str | None, up: ArrayLike | None) -> dict[str, str | None]:
    """Return the query that asks for a frame of reference."""
    if up is None or isinstance(up, str):
        return {"frame": frame, "up": up}
    return {"frame": frame, "up": ",".join(map(str, up_in_json(up)))}


def up_in_json(up: ArrayLike) -> str | list[float]:
    """Return ``auto``, or a vector as a list."""
    return up if isinstance(up, str) else np.asarray(up, np.float64).ravel().tolist()


def identifier(resource: Any) -> str:
    """Return the identifier of a resource, or the one that was given."""
    return resource if isinstance(resource, str) else str(resource.id)
