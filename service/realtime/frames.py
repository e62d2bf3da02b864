"""Frames that a fitted prior can lift: of its keypoints and views."""

from models.lifting.fitted_prior import FittedPrior
from service.http.errors import invalid
from service.settings import Settings
from service.wire.captures import to_capture
from store.capture import Capture


def to_frames(
    frames: object,
    confidence: object,
    views: list[int] | None,
    prior: FittedPrior,
    settings: Settings,
    *,
    times: object = None,
    field: str = "frames",
    max_bytes: int | None = None,
) -> Capture:
    """Return frames that the prior can lift, from nested lists or arrays; errors name ``field``.

    No array takes more than ``max_bytes``, without it as many as the largest body has.

    Raises
    ------
    ApiError
        422 for whatever does not make frames, or not of the keypoints and views of the fit.
    """
    expected = prior.keypoints_per_frame
    capture = to_capture(
        frames,
        confidence,
        times=times,
        settings=settings,
        max_bytes=max_bytes,
        keypoints_field=field,
        expected_keypoints=expected,
    )
    _, came_views, came, _ = capture.keypoints.shape
    if came != expected:
        raise invalid(
            f"/{field}",
            f"expected {expected} keypoints as in the model, got {came}; keep the order of the "
            "fitted capture and write null for what was not observed",
        )
    if views is not None:
        check_views(views, prior, came_views)
    return capture


def check_views(views: list[int], prior: FittedPrior, came: int) -> None:
    """Raise ``ApiError`` unless ``views`` names a view of the fit for each view of the frame."""
    if len(views) != came:
        raise invalid("/views", f"expected one index per view: {came}, got {len(views)}")
    if len(set(views)) < came:
        raise invalid("/views", f"expected different views of the fit, got {views}")
    if prior.known_views and max(views) >= prior.known_views:
        last = prior.known_views - 1
        raise invalid("/views", f"expected views of the fit, 0 to {last}, got {max(views)}")
