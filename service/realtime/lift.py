"""Lifting: 2D keypoints to 3D structure and cameras, in real time."""

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import nullcontext
from functools import partial
from typing import Annotated, Any, NamedTuple, TypeVar, cast

from fastapi import APIRouter, Query, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.routing import APIRoute
from pydantic import BaseModel, ConfigDict
from starlette.responses import Response, StreamingResponse

from models.lifting import lift as lifts
from models.lifting.film import film_of
from models.lifting.lift_findings import lift_findings
from models.lifting.observing import ObservedFrames
from models.settings.config import Index, Refine
from models.settings.keypoints import MAX_VIEWS
from models.settings.rooms import FrameOfReference, Up
from models.settings.uncertainty import Uncertainty, numbers_of, of_uncertainty
from service.http.errors import BODY_PROBLEMS, invalid, problems
from service.http.key_rates import Rates
from service.http.keyring import caller_of
from service.http.negotiation import NPZ, OCTETS
from service.http.operations import binary_responses, request_body
from service.http.places import Threads, Turns
from service.http.uploads import LARGE_BYTES, Upload, read_body
from service.realtime.engine import Engine
from service.realtime.frames import to_frames
from service.realtime.rooms import Rooms, check_known
from service.realtime.warm_models import WarmModel
from service.settings import Settings
from service.wire.captures import read_arrays
from service.wire.findings import Findings
from service.wire.json_bodies import read_json
from service.wire.representations import (
    JSON,
    Format,
    FormatQuery,
    arrays_response,
    chosen_format,
    json_pieces,
    parts_of,
)
from service.wire.requests import LiftRequest
from service.wire.rooms import FrameQuery, UpQuery, is_room, read_up
from service.wire.schemas import (
    LIFTED_FRAME,
    REFINE,
    UNCERTAINTY,
    VIEWS,
    LiftedFrame,
)
from store.capture import Capture
from worker.rooms import Room

TINY_BYTES = 32 * 1024  # worked on in less time than it takes to switch threads, or not much more
# What an answer has: bytes of arrays for each keypoint without its uncertainty, each view, each
# keypoint of a view and each number of uncertainty, and JSON for each of these.
KEYPOINT_BYTES, VIEW_BYTES, SEEN_BYTES, UNCERTAINTY_BYTES, JSON_BYTES = 13, 112, 4, 4, 6
PATIENCE_SECONDS = 0.1  # before it is looked whether a client still waits

Result = TypeVar("Result")


class Lift(BaseModel):
    """Lifted frames, in the order they came."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "model": "mdl_01m7ysqde9xx2qq81h8t3gh6xr",
                "frames": [LIFTED_FRAME],
                "findings": [],
            }
        }
    )

    model: str
    frames: list[LiftedFrame]
    findings: Findings


ModelQuery = Annotated[
    str | None,
    Query(max_length=200, description="The model, or an alias, for frames that come as bytes."),
]
RefineQuery = Annotated[Refine | None, Query(description=REFINE)]
UncertaintyQuery = Annotated[
    Uncertainty | None, Query(description=f"{UNCERTAINTY} The default is `sd`.")
]
ViewsQuery = Annotated[
    list[Index] | None,
    Query(max_length=MAX_VIEWS, description=f"{VIEWS} Repeat it: `views=0&views=2`."),
]


class _Asked(NamedTuple):
    model: WarmModel
    capture: Capture
    refine: Refine | None
    views: list[int] | None
    uncertainty: Uncertainty
    room: Room | None


class _Query(NamedTuple):
    """The parameters of the query, for fields that the body leaves out."""

    model: str | None
    refine: Refine | None
    views: list[int] | None
    frame: FrameOfReference | None
    up: str | None
    uncertainty: Uncertainty | None
    format: Format


def _understand(
    upload: Upload,
    query: _Query,
    settings: Settings,
    model_of: Callable[[str], WarmModel | None],
    room_of: Callable[[WarmModel, Up | None], Room | None],
) -> _Asked | None:
    """Return the request of the body, completed by the query.

    None if ``model_of`` has no such model, or ``room_of`` no such room.
    """
    if upload.is_json:
        asked = read_json(upload, LiftRequest)
    else:
        if query.model is None:
            raise invalid(
                "/model", "expected the model's identifier in the query: /lift?model=mdl_..."
            )
        known = frozenset({"frames", "keypoints", "confidence", "times"})
        found = read_arrays(upload, known)
        frames = found.get("frames", found.get("keypoints"))
        if frames is None:
            raise invalid(
                "/frames", "expected an array of this name: (frames, views, keypoints, 2)"
            )
        asked = LiftRequest(
            model=query.model,
            frames=frames,
            confidence=found.get("confidence"),
            times=found.get("times"),
        )
    views = query.views if asked.views is None else asked.views
    up = read_up(query.up) if asked.up is None else asked.up
    in_room = is_room(asked.frame or query.frame, up)
    model = model_of(asked.model)
    if model is None:
        return None
    capture = to_frames(
        asked.frames,
        asked.confidence,
        views,
        model.prior,
        settings,
        times=asked.times,
        max_bytes=upload.max_array_bytes,
    )
    uncertainty = asked.uncertainty or query.uncertainty or "sd"
    _check_answer(capture, uncertainty, query.format, settings)
    room = None
    if in_room:
        room = room_of(model, up)
        if room is None:
            return None
        check_known(room, views, capture.keypoints.shape[1])
    return _Asked(model, capture, asked.refine or query.refine, views, uncertainty, room)


def _observe(asked: _Asked) -> ObservedFrames:
    """Prepare frames with times for the model: in step, and smoothed in time."""
    capture = asked.capture
    shown = capture.keypoints, capture.confidence, capture.times
    return film_of(asked.model.prior, shown, asked.views).observe()


def answer_bytes(frames: int, views: int, keypoints: int, uncertainty: Uncertainty) -> int:
    """Return how many bytes the arrays of an answer take."""
    of_keypoint = KEYPOINT_BYTES + SEEN_BYTES * views + UNCERTAINTY_BYTES * numbers_of(uncertainty)
    return frames * (of_keypoint * keypoints + VIEW_BYTES * views)


def _check_answer(
    capture: Capture, uncertainty: Uncertainty, format: Format, settings: Settings
) -> None:
    """Refuse frames whose answer would be longer than a body may be."""
    frames, views, keypoints, _ = capture.keypoints.shape
    answer = answer_bytes(frames, views, keypoints, uncertainty)
    if format == "json":
        answer *= JSON_BYTES
    if answer > settings.max_body_bytes:
        npz = " Bytes take less than JSON: format=npz." if format == "json" else ""
        raise invalid(
            "/frames",
            f"expected frames whose answer has {settings.max_body_bytes} bytes at most, these "
            f"{frames} would have some {answer}: send them in parts, or store them and have them "
            f"lifted by workers (POST /datasets, POST /lifts).{npz}",
        )


class DirectRoute(APIRoute):
    """Calls its endpoint with the request alone where nothing is to be checked before.

    That saves half of FastAPI's time: where there is no query, and no web page that asks.
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return the function that answers a request."""
        solve, endpoint = super().get_route_handler(), self.endpoint

        async def handle(request: Request) -> Response:
            if request.scope["query_string"] or "origin" in request.headers:
                return await solve(request)
            answer: Response = await endpoint(request)
            return answer

        return handle


router = APIRouter(tags=["lift"], route_class=DirectRoute)


@router.post(
    "/lift",
    operation_id="lift",
    response_model=Lift,
    responses=problems(*BODY_PROBLEMS, "not_found", "conflict", "not_acceptable")
    | binary_responses("The lifted frames.", OCTETS, NPZ),
    openapi_extra=request_body(
        LiftRequest,
        binary="A safetensors or .npz file with `frames` (or `keypoints`: frames, views, "
        "keypoints, 2) and optionally `confidence` and `times`; the query has the others.",
    ),
)
async def lift(
    request: Request,
    model: ModelQuery = None,
    refine: RefineQuery = None,
    views: ViewsQuery = None,
    frame: FrameQuery = None,
    up: UpQuery = None,
    uncertainty: UncertaintyQuery = None,
    format: FormatQuery = None,
) -> Response:
    """Lift frames to 3D with a fitted model.

    The query completes the body: `model` for bytes, and `refine`, `views`, `frame`, `up` and
    `uncertainty` for either.

    Frames may have any number of the views, in any order; keypoints and views may be missing. Every
    frame is lifted on its own, unless `times` are given: the frames are then one film, smoothed in
    time if the model was fitted to one. Structures are in the model's canonical frame, or in the
    room of its static cameras (`frame`), with the handedness that the fit decided on. Each view's
    `camera` is the camera model that explains it.
    """
    engine: Engine = request.app.state.engine
    rooms: Rooms = request.app.state.rooms
    format = chosen_format(request, format)
    upload = await read_body(request)
    query = _Query(model, refine, views, frame, up, uncertainty, format)
    caller, rates = caller_of(request), cast(Rates, request.app.state.rates)
    project = caller.author.project
    understand = partial(_understand, upload, query, request.app.state.settings)
    asked = await _run(
        request,
        upload.decoded_bytes,
        understand,
        partial(engine.models.warm, project),
        rooms.remembered,
    )
    if asked is None:  # the model or its room is not in memory: the records are read
        async with request.app.state.large_uploads.turn(request):
            asked = await run_in_threadpool(
                understand, partial(engine.models.get, project), rooms.find
            )
        assert asked is not None  # noqa: S101
    await rates.take_frames(caller, len(asked.capture.keypoints))
    if asked.capture.times is None:
        answer = engine.lift(
            asked.model,
            asked.capture.keypoints,
            confidence=asked.capture.confidence,
            refine=asked.refine,
            views=asked.views,
            uncertainty=asked.uncertainty,
            key_id=caller.author.key_id,
        )
    else:
        size = max(upload.decoded_bytes, TINY_BYTES + 1)  # smoothing takes longer than that
        observed = await _run(request, size, _observe, asked)
        answer = engine.lift_observed(
            asked.model,
            observed,
            refine=asked.refine,
            uncertainty=asked.uncertainty,
            key_id=caller.author.key_id,
        )
    lifted = await _unless_gone(request, answer)
    if lifted is None:
        return Response(status_code=499)  # the client is gone
    size = JSON_BYTES * sum(array.nbytes for array in lifted.arrays.values())
    in_parts = format == "json" and size >= LARGE_BYTES
    return await _run(request, size, _answer, request, asked, lifted, format, in_parts)


def _answer(
    request: Request, asked: _Asked, lifted: lifts.LiftedFrames, format: Format, in_parts: bool
) -> Response:
    if asked.room is not None:
        lifted = asked.room.place(lifted, asked.views)
    arrays = of_uncertainty(lifted.arrays, asked.uncertainty)
    about: dict[str, str | None] = {"model": asked.model.id}
    findings = lift_findings(lifted, asked.model.prior)
    if in_parts:  # as a whole it would take many times what was asked
        pieces = json_pieces(parts_of(arrays), about, findings)
        return StreamingResponse(
            _made_in_thread(request, pieces), headers={"Vary": "Accept"}, media_type=JSON
        )
    return arrays_response(request, arrays, about, findings, format=format, filename="lift")


async def _made_in_thread(request: Request, pieces: Iterator[bytes]) -> AsyncIterator[bytes]:
    """Give pieces that are made one by one, as the client takes them, in threads for bodies."""
    bodies: Threads = request.app.state.lift_bodies
    while piece := await bodies.run(request, partial(next, pieces, b"")):
        yield piece


async def _run(
    request: Request, size: int, work: Callable[..., Result], *arguments: object
) -> Result:
    """Do work of about so many bytes here if that is tiny, else in a thread; large ones take turns.

    Neither threads nor turns are those of requests that wait for records.
    """
    if size <= TINY_BYTES:
        return work(*arguments)
    bodies: Threads = request.app.state.lift_bodies
    large: Turns = request.app.state.large_lifts
    async with large.turn(request, patient=True) if size >= LARGE_BYTES else nullcontext():
        return await bodies.run(request, work, *arguments)


async def _unless_gone(
    request: Request, answer: "asyncio.Future[lifts.LiftedFrames]"
) -> lifts.LiftedFrames | None:
    """Wait for the answer; if the client goes away meanwhile, give it up and return None."""
    patience = answer.get_loop().call_later(PATIENCE_SECONDS, _watch, request, answer)
    try:
        return await answer
    except asyncio.CancelledError:
        task = asyncio.current_task()
        if task is not None and task.cancelling():
            raise
        return None
    finally:
        patience.cancel()


def _watch(request: Request, answer: "asyncio.Future[lifts.LiftedFrames]") -> None:
    """Cancel the answer when the client goes away."""

    async def disconnected() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass
        answer.cancel()

    watching = asyncio.create_task(disconnected())
    answer.add_done_callback(lambda _: watching.cancel())
