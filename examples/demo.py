"""Fewview from end to end: a capture goes in, structures come out, and frames never seen before.

    python examples/demo.py [CAPTURE.npz]

Everything happens as a user would do it, over HTTP against a service that is started here:

1. `POST /datasets` and `POST /datasets/{id}/frames` store the capture, less the frames held out;
2. `POST /fits` queues a fit, `GET /fits/{id}/events` follows it;
3. `GET /fits/{id}/reconstruction` gives every fitted frame in 3D, `GET /models/{id}` the figures,
   `GET /models/{id}/cameras` the cameras that were found;
4. `POST /lift` lifts the frames that were held out, first together, then one by one.

The last line of the output is a JSON object with all figures.
"""

import argparse
import json
import signal
import sys
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import httpx2
import numpy as np
from capture import Capture, CaptureError, Float32, hold_out, read_capture
from fewview.embedded import ServiceError, running_service
from numpy.typing import NDArray
from picture import Array, Scene, draw
from safetensors.numpy import load
from screen import ProgressDisplay, console, number, page_of, show, show_cameras, show_findings

from models.capture.metrics import Accuracy, pa_mpjpe, pck, procrustes_by_size

HELD_OUT = 0.1  # share of the frames that the fit does not see
SEED = 0
CHUNK = 1000  # frames in one request
SINGLE_LIFTS = 300  # requests that are timed, after WARM_UP that are not
WARM_UP = 30
DATA = "data"  # of the service, in the output folder: `fewview serve` shows it afterwards
BYTES = "application/octet-stream"  # bodies of .npz or safetensors; as Accept: safetensors
QUANTILES = {"a good frame": 0.1, "a middling frame": 0.5, "a bad frame": 0.9}

Lifted = dict[str, NDArray[Any]]  # the arrays of a lift, by name


class DemoError(Exception):
    """The service would not, or could not; the message says why."""


class Result(NamedTuple):
    """A capture's frames and what they were lifted to."""

    capture: Capture
    lifted: Lifted


def main() -> None:
    """Run the command line: exit status 0, 2 if the capture cannot be used, 1 for all else."""
    for end in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(end, _leave)
    arguments = parse_arguments()
    try:
        capture = read_capture(arguments.capture)
        with running_service(data=arguments.output / DATA) as address:
            figures = run(address, capture, arguments)
    except CaptureError as error:
        fail(2, f"{arguments.capture}: {error}")
    except (DemoError, ServiceError, OSError, httpx2.HTTPError) as error:
        fail(1, str(error))
    except KeyboardInterrupt:
        fail(130, "interrupted; the service is stopped")
    print(json.dumps(figures))


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description="Fit a capture with a Fewview of its own, lift frames that the fit did not "
        "see, and show how good and how fast that was."
    )
    parser.add_argument(
        "capture",
        type=Path,
        nargs="?",
        default=Path(__file__).with_name("three_actors.npz"),
        help=".npz file with `keypoints` (frames, views, keypoints, 2) in pixels, NaN where not "
        "observed; optionally `confidence` (frames, views, keypoints), `points3d` (frames, "
        "keypoints, 3), `times` (frames,) or (frames, views) in seconds, `fps`, `keypoint_names`, "
        "`edges` (n, 2), `image_sizes` (views, 2); default: "
        "%(default)s",
    )
    parser.add_argument("--steps", type=int, help="optimiser steps of the fit; fewer are faster")
    parser.add_argument(
        "--output", type=Path, default=Path("demo-output"), help="for what comes: %(default)s"
    )
    return parser.parse_args()


def run(address: str, capture: Capture, arguments: argparse.Namespace) -> dict[str, Any]:
    """Take a capture through the whole service; return the figures."""
    seen, unseen = hold_out(capture, HELD_OUT, SEED)
    threshold = pck_threshold(capture)
    given = {} if arguments.steps is None else {"steps": arguments.steps}
    config = {"pck_threshold": threshold, **given}
    # One client is one pool of connections, which stay open between requests.
    with httpx2.Client(base_url=address, timeout=120, trust_env=False) as client:
        console.print(f"Fewview at {address}, capture {arguments.capture.name}")
        dataset = upload(client, seen, arguments.capture.stem[:200] or "capture")
        fit = follow(client, create_fit(client, dataset["id"], config))
        model = call(client, "GET", f"/models/{fit['model_id']}").json()
        cameras = call(client, "GET", f"/models/{model['id']}/cameras").json()
        show_cameras(cameras)
        show_findings(model["findings"])
        fitted = Result(seen, reconstruction(client, fit["id"]))
        new = Result(unseen, lift(client, model["id"], unseen) if len(unseen) else {})
        latencies = time_lifts(client, model["id"], unseen if len(unseen) else seen)
    figures = {
        "capture": arguments.capture.name,
        "frames": len(capture),
        "frames_unseen": len(unseen),
        "views": capture.keypoints.shape[1],
        "keypoints": capture.keypoints.shape[2],
        "missing_fraction": float(1 - capture.observed().mean()),
        **accuracies(fitted, new, threshold),
        "pa_mpjpe_by_service": model["pa_mpjpe"],
        "frames_lifted": model["frames_lifted"],
        "reprojection_error_px": model["reprojection_error"],
        "reprojection_error_px_unseen": mean_reprojection_error(new.lifted),
        "lift_ms_p50": float(np.percentile(latencies, 50)),
        "lift_ms_p99": float(np.percentile(latencies, 99)),
        "cameras": cameras["arrangement"],
        "focal_px": [view["focal"] and view["focal"][0] for view in cameras["views"]],
        "findings": [finding["code"] for finding in model["findings"]],
        "fit_seconds": fit["seconds"],
        "steps": fit["config"]["steps"],
    }
    figures["picture"] = str(draw_some(fitted, new, figures, arguments.output))
    figures["page"] = page_of(fit["id"], arguments.output / DATA)
    show(figures)
    return figures


# --- Over HTTP -----------------------------------------------------------------------------------


def call(client: httpx2.Client, method: str, path: str, **request: Any) -> httpx2.Response:
    """Send a request; an error comes as a problem (RFC 9457), whose words are passed on."""
    response = client.request(method, path, **request)
    if response.is_success:
        return response
    problem = response.json()
    reasons = [f"{e['pointer']}: {e['detail']}" for e in problem.get("errors", [])]
    message = "; ".join(reasons) or problem.get("detail") or problem["title"]
    if response.status_code == httpx2.codes.UNPROCESSABLE_CONTENT:
        raise CaptureError(message)
    raise DemoError(f"{method} {path}: {message}")


def upload(client: httpx2.Client, capture: Capture, name: str) -> dict[str, Any]:
    """Store a capture, in chunks if it is long; return the dataset.

    The truth goes along for evaluation: the service computes errors with it, and nothing else.
    """
    arrays = ("keypoints", "confidence", "points3d", "times")
    first, *others = chunks(capture)
    dataset: dict[str, Any] = call(
        client,
        "POST",
        "/datasets",
        params={"name": name},
        content=first.npz(*arrays, "keypoint_names", "edges", "image_sizes"),
        headers={"Content-Type": BYTES},
    ).json()
    for chunk in others:
        dataset = call(
            client,
            "POST",
            f"/datasets/{dataset['id']}/frames",
            content=chunk.npz(*arrays),
            headers={"Content-Type": BYTES},
        ).json()
    console.print(
        f"Stored {dataset['frames']} frames of {dataset['views']} views of "
        f"{dataset['keypoints']} keypoints as {dataset['id']}"
    )
    return dataset


def chunks(capture: Capture) -> Iterator[Capture]:
    """Cut a capture into pieces of a size to send."""
    for start in range(0, len(capture), CHUNK):
        yield capture.frames(slice(start, start + CHUNK))


def create_fit(client: httpx2.Client, dataset_id: str, config: dict[str, Any]) -> str:
    """Queue a fit and return its identifier."""
    fit = call(client, "POST", "/fits", json={"dataset_id": dataset_id, "config": config}).json()
    return str(fit["id"])


def follow(client: httpx2.Client, fit_id: str) -> dict[str, Any]:
    """Show a fit's progress until it has ended; return it, with the seconds that it took."""
    with ProgressDisplay() as display, client.stream("GET", f"/fits/{fit_id}/events") as response:
        for event in httpx2.EventSource(response):
            fit: dict[str, Any] = json.loads(event.data)
            display.show(fit)
            if event.event == "end":
                break
    if fit["status"] == "failed" and fit["error"]["code"] == "unusable_capture":
        raise CaptureError(fit["error"]["message"])
    if fit["status"] != "succeeded":
        raise DemoError(f"the fit {fit['status']}: {(fit['error'] or {}).get('message')}")
    started, finished = (
        datetime.fromisoformat(fit[f"{what}_at"]) for what in ("started", "finished")
    )
    return fit | {"seconds": (finished - started).total_seconds()}


def reconstruction(client: httpx2.Client, fit_id: str) -> Lifted:
    """Download every fitted frame in 3D, as arrays."""
    response = call(client, "GET", f"/fits/{fit_id}/reconstruction", headers={"Accept": BYTES})
    return load(response.content)


def lift(client: httpx2.Client, model_id: str, capture: Capture) -> Lifted:
    """Lift many frames, as arrays in both directions."""
    parts = [
        load(
            call(
                client,
                "POST",
                "/lift",
                params={"model": model_id},
                content=chunk.npz("keypoints", "confidence"),
                headers={"Content-Type": BYTES, "Accept": BYTES},
            ).content
        )
        for chunk in chunks(capture)
    ]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def time_lifts(client: httpx2.Client, model_id: str, capture: Capture) -> list[float]:
    """Lift frames one at a time, as JSON over one connection; return the milliseconds of each.

    That is what a client waits for: JSON written, sent, lifted, sent back and read.
    """
    milliseconds = []
    for index in range(WARM_UP + SINGLE_LIFTS):
        frame = capture.frames(slice(index % len(capture), index % len(capture) + 1))
        frames = to_json(frame.keypoints)
        confidence = None if frame.confidence is None else to_json(frame.confidence)
        started = time.perf_counter()
        body = {"model": model_id, "frames": frames, "confidence": confidence}
        call(client, "POST", "/lift", json=body).json()
        milliseconds.append(1000 * (time.perf_counter() - started))
    return milliseconds[WARM_UP:]


def to_json(values: Float32) -> Any:
    """Return nested lists, with None (null in JSON) for what was not observed."""
    nested = values.astype(object)
    nested[np.isnan(values)] = None
    return nested.tolist()


# --- What it is worth ----------------------------------------------------------------------------


def accuracies(fitted: Result, new: Result, threshold: float) -> dict[str, Any]:
    """Compare with the truth, if there is one, up to rotation, position and size of each frame.

    Weak perspective cannot distinguish a structure from its mirror image. Whether all structures
    are mirrored is one bit of the fit: it is read off the fitted frames and holds for the unseen.
    """
    figures: dict[str, Any] = dict.fromkeys(
        ("pa_mpjpe", "pa_mpjpe_unseen", "pck", "pck_unseen", "pck_threshold", "mirrored")
    )
    if fitted.capture.points3d is None:
        return figures
    accuracy = pa_mpjpe(fitted.lifted["points3d"], fitted.capture.points3d)
    figures |= {
        "pa_mpjpe": finite(accuracy.mean),
        "pck": finite(pck(accuracy, threshold)),
        "pck_threshold": threshold,
        "mirrored": accuracy.reflected,
    }
    if new.lifted:
        accuracy = accuracy_of(new, mirrored=accuracy.reflected)
        figures["pa_mpjpe_unseen"] = finite(accuracy.mean)
        figures["pck_unseen"] = finite(pck(accuracy, threshold))
    return figures


def accuracy_of(result: Result, *, mirrored: bool) -> Accuracy:
    """Compare frames with their truth, mirrored or not as the fit was."""
    points = result.lifted["points3d"] * (-1 if mirrored else 1)
    return pa_mpjpe(points, np.asarray(result.capture.points3d), reflection="never")


def mean_reprojection_error(lifted: Lifted) -> float | None:
    """Return the mean over the views that have a camera, in pixels."""
    errors = lifted.get("reprojection_errors", np.empty(0))
    known = errors[np.isfinite(errors)]
    return float(known.mean()) if known.size else None


def extent(capture: Capture) -> float | None:
    """Return how large the subject is in the truth: the median diagonal of its bounding box."""
    if capture.points3d is None:
        return None
    whole = capture.points3d[np.isfinite(capture.points3d).all((1, 2))]
    if not len(whole):
        return None
    return float(np.median(np.linalg.norm(np.ptp(whole, axis=1), axis=-1)))


def in_metres(size: float | None) -> bool:
    """Guess from the subject's size whether the truth is in metres: a child's to a horse's."""
    return size is not None and 0.4 < size < 4


def pck_threshold(capture: Capture) -> float:
    """Return 0.1 where the truth seems to be in metres, else a twentieth of the subject's size."""
    size = extent(capture)
    return 0.1 if size is None or in_metres(size) else 0.05 * size


def finite(value: float) -> float | None:
    """Return None for what JSON cannot say."""
    return value if np.isfinite(value) else None


# --- On paper ------------------------------------------------------------------------------------


def draw_some(fitted: Result, new: Result, figures: dict[str, Any], folder: Path) -> Path:
    """Draw a good, a middling and a bad frame, of those that the fit did not see if there are."""
    result = new if new.lifted else fitted
    mirrored = bool(figures["mirrored"])
    errors, unit = frame_errors(result, mirrored=mirrored)
    known = np.flatnonzero(np.isfinite(errors))
    ranked = known[np.argsort(errors[known])]
    if len(ranked) < len(QUANTILES):
        picked = [("a frame", frame) for frame in ranked]
    else:
        picked = [(name, ranked[round(q * (len(ranked) - 1))]) for name, q in QUANTILES.items()]
    scenes = [
        scene(result, frame, f"{name}: {number(errors[frame])}{unit}", mirrored=mirrored)
        for name, frame in picked
    ]
    edges = [] if result.capture.edges is None else [(a, b) for a, b in result.capture.edges]
    which = "frames the fit did not see" if result is new else "fitted frames"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{Path(figures['capture']).stem}.png"
    draw(path, scenes, edges, f"{figures['capture']}: {which}")
    return path.absolute()


def frame_errors(result: Result, *, mirrored: bool) -> tuple[NDArray[np.float64], str]:
    """Return each frame's error, NaN where it has none, and of which kind it is.

    Against the truth where it is known of any frame, else against what the views saw.
    """
    if result.capture.points3d is not None:
        errors = accuracy_of(result, mirrored=mirrored).per_frame
        if np.isfinite(errors).any():
            return errors, " off the truth"
    pixels = np.ma.masked_invalid(result.lifted["reprojection_errors"])
    return pixels.mean(axis=1).filled(np.nan), " px off its views"


def scene(result: Result, frame: int, title: str, *, mirrored: bool) -> Scene:
    """Turn a frame as the camera that saw most of it sees it, the truth moved along."""
    view = int(result.lifted["keypoints_used"][frame].argmax())
    structure = result.lifted["points3d"][frame] @ result.lifted["rotations"][frame, view].T
    if mirrored:  # to a weak-perspective camera, mirrored is the same as near for far
        structure = structure * np.array([1, 1, -1])
    truth: Array | None = None
    if result.capture.points3d is not None:
        truth = procrustes_by_size(result.capture.points3d[frame, None], structure[None])[0]
    image = result.capture.keypoints[frame, view].astype(np.float64)
    return Scene(title, image, structure.astype(np.float64), truth)


def fail(status: int, message: str) -> NoReturn:
    """End with one line on stderr."""
    print(f"demo.py: {message}", file=sys.stderr)
    sys.exit(status)


def _leave(_number: int, _frame: object) -> NoReturn:
    raise KeyboardInterrupt


if __name__ == "__main__":
    main()
