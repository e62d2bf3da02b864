"""Labels: which images of a fit a human should label, and what it accepts, to train detectors."""

from typing import Annotated, NamedTuple

import numpy as np
from fastapi import APIRouter, Depends, Query, Request
from numpy.typing import NDArray
from starlette.responses import Response

from models.capture.clocks import positions_in_step, times_of_views
from models.labelling.accepted import Sizes, accept
from models.labelling.evidence import Evidence, weigh
from models.labelling.filmed import Filmed, as_filmed
from models.labelling.worth import APART, Ranking, rank
from service.http.dependencies import StoreDep
from service.http.downloads import bytes_response
from service.http.errors import invalid, problems
from service.http.negotiation import OCTETS
from service.http.operations import file_responses
from service.realtime.dependencies import EngineDep, RoomsDep
from service.realtime.engine import Engine
from service.realtime.rooms import Rooms
from service.resources.animations import take_turn
from service.resources.fits import FitDep
from service.resources.reconstructions import model_of, stored_arrays
from service.wire.labels import (
    FitLabels,
    Frames,
    LabelFormat,
    LabelledImages,
    LabelSource,
    frames_of_all,
    frames_worth,
    labels_of,
    labels_zip,
    with_corrected,
)
from service.wire.skeletons import Skeleton
from store import corrections, dataset_changes, datasets, lookup, records
from store.database import Store

router = APIRouter(prefix="/fits", tags=["fits"])

MOST_KEYPOINTS = 2_000_000  # of all frames and views: half a gigabyte of memory
MOST_LISTED, USUALLY_LISTED = 500, 50
TOGETHER = {"lightning-pose"}  # formats whose views have rows of the same moments

ApartQuery = Annotated[
    int,
    Query(
        ge=1,
        le=100_000,
        description="Frames between two images of a view for the same reason, at least.",
    ),
]


class Material(NamedTuple):
    """What labels of a fit are made of."""

    filmed: Filmed
    evidence: Evidence
    view_names: list[str]
    sizes: Sizes
    skeleton: Skeleton
    corrected: NDArray[np.bool_]  # (N, K, P) by a human, in the views' own frames

    def ranked(self, most: int, apart: int) -> Ranking:
        """Return the images that are most worth labelling."""
        return rank(self.filmed, self.evidence, self.sizes, most=most, apart=apart)


def read_material(fit: records.FitRecord, store: Store, engine: Engine, rooms: Rooms) -> Material:
    """Read the reconstruction and the keypoints of a fit.

    Raises
    ------
    ConflictError
        If it has no model.
    NotFoundError
        If its dataset was deleted.
    ApiError
        422 if there is too much of it.
    """
    model = lookup.get(store, records.ModelRecord, model_of(fit))
    dataset, known = dataset_changes.corrections_of(store, fit.dataset_id)
    views = dataset.views
    if fit.frames * views * model.keypoints > MOST_KEYPOINTS:
        raise invalid(
            "/fit_id",
            f"expected {MOST_KEYPOINTS} keypoints at most, frames times views times keypoints; "
            f"this fit has {fit.frames} x {views} x {model.keypoints}: fit the capture in parts",
        )
    capture = datasets.load(store, fit.dataset_id, frames=fit.frames, corrected=known)
    found = stored_arrays(fit, store)
    warm = engine.models.read(store.project, model.id)
    cameras, times = warm.prior.cameras, datasets.times_of(dataset, capture)
    frames, placed = None, None
    if times is not None:
        frames = positions_in_step(times_of_views(times, views), warm.prior.capture.clocks)
    if cameras is not None and cameras.static.any():
        placed = rooms.find(warm, None).place_arrays(found)["points3d"]
    shown = capture.keypoints, capture.confidence, found, frames, cameras, placed
    filmed = as_filmed(*shown, warm.prior.capture.mends)
    sizes = dataset.image_sizes or [None] * views
    return Material(
        filmed,
        weigh(filmed),
        dataset.view_names or [f"view{view}" for view in range(views)],
        [None if size is None else (int(size[0]), int(size[1])) for size in sizes],
        Skeleton.model_validate(model.skeleton or {}),
        corrections.places_of(known, capture.keypoints.shape[:3]),
    )


@router.get(
    "/{fit_id}/labels",
    dependencies=[Depends(take_turn, scope="function")],
    responses=problems("not_found", "conflict"),
)
def get_labels(
    fit: FitDep,
    store: StoreDep,
    engine: EngineDep,
    rooms: RoomsDep,
    limit: Annotated[int, Query(ge=1, le=MOST_LISTED)] = USUALLY_LISTED,
    apart: ApartQuery = APART,
) -> FitLabels:
    """List the images that would teach the detector most, if a human labelled them.

    An image is a frame of a view. It is listed for keypoints that are outliers, that contradict the
    other views, or that were missed though others see them well, and for a pose unlike all others.
    Of each burst there is one, and none that looks like one before it.
    """
    material = read_material(fit, store, engine, rooms)
    ranking = material.ranked(limit, apart)
    names, noise = material.view_names, material.evidence.noise
    return FitLabels.of(fit.id, fit.dataset_id, ranking, names, noise)


@router.get(
    "/{fit_id}/labels/file",
    response_class=Response,
    dependencies=[Depends(take_turn, scope="function")],
    responses=problems("not_found", "conflict", "range_not_satisfiable")
    | file_responses("The files of the format, in a ZIP.", OCTETS),
)
def download_labels(
    fit: FitDep,
    store: StoreDep,
    engine: EngineDep,
    rooms: RoomsDep,
    request: Request,
    format: Annotated[
        LabelFormat,
        Query(
            description="`dlc` (DeepLabCut's CollectedData), `dlc-machine` (its machine labels; "
            "the weight is the likelihood), `coco` (keypoints, with weights), `lightning-pose`."
        ),
    ],
    source: Annotated[
        LabelSource,
        Query(
            description="`reprojections`: where the fit shows each keypoint; `keypoints`: those "
            "of the detector that the fit agrees with."
        ),
    ] = "reprojections",
    images: Annotated[
        LabelledImages,
        Query(
            description="`worth-labelling`: those of `GET /fits/{fit_id}/labels`; `all` that "
            "have a label."
        ),
    ] = "worth-labelling",
    most: Annotated[
        int | None,
        Query(
            ge=1,
            le=1_000_000,
            description="How many images at most: of those worth labelling the first (without it "
            "50, at most 500), of all so many of each view, evenly spread (without it all).",
        ),
    ] = None,
    least_weight: Annotated[
        float, Query(ge=0, le=1, description="Labels of less weight are left out.")
    ] = 0.0,
    scorer: Annotated[
        str,
        Query(
            pattern="^[A-Za-z0-9][A-Za-z0-9_-]{0,39}$",
            description="As a project of DeepLabCut calls who labels.",
        ),
    ] = "fewview",
    apart: ApartQuery = APART,
) -> Response:
    """Download the keypoints that the fit accepts, as labels to train a detector on.

    Keypoints that were corrected in the dataset are labels of weight 1 where they were put, removed
    ones are none, and their images are among those written, besides `most`.

    Images are named `labeled-data/VIEW/img0123.png`, by the frame in the view's own film.
    """
    material = read_material(fit, store, engine, rooms)
    corrected = material.corrected
    accepted = accept(material.filmed, material.evidence, material.sizes, source, corrected)
    frames: Frames
    if images == "all":
        frames = with_corrected(frames_of_all(accepted, most), corrected)
    else:
        ranking = material.ranked(min(most or USUALLY_LISTED, MOST_LISTED), apart)
        together = format in TOGETHER
        frames = frames_worth(ranking, material.filmed, corrected, together=together)
    if not any(map(len, frames)):
        raise invalid(
            "/images",
            "expected images that have labels, and there are none; `images=all` takes all that "
            "the fit accepts, not only what is worth labelling",
        )
    labels = labels_of(
        accepted,
        frames,
        view_names=material.view_names,
        sizes=material.sizes,
        skeleton=material.skeleton,
        least_weight=least_weight,
        scorer=scorer,
    )
    filename = f"{fit.id}-labels-{format}.zip"
    return bytes_response(request, labels_zip(labels, format), media_type=OCTETS, filename=filename)
