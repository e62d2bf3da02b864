"""Captures: what the cameras of a dataset saw, as it was uploaded, with its corrections."""

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Request
from starlette.responses import Response

from service.http.dependencies import Identifier, StoreDep
from service.http.downloads import ranged_response
from service.http.errors import problems
from service.http.negotiation import OCTETS
from service.http.operations import file_responses
from store import dataset_changes, lookup, records
from store.capture_files import capture_file

router = APIRouter(prefix="/datasets", tags=["datasets"])


@router.get(
    "/{dataset_id}/capture",
    response_class=Response,
    responses=problems("not_found", "range_not_satisfiable")
    | file_responses("The capture as an npz file, as `POST /datasets` takes it.", OCTETS),
)
def download_capture(
    dataset_id: Identifier,
    store: StoreDep,
    request: Request,
    corrected: Annotated[
        bool, Query(description="With corrections applied; without them, as it was detected.")
    ] = True,
) -> Response:
    """Download a dataset's capture as an npz file, whole or a range of its bytes.

    All arrays as they were uploaded, to the last bit, but for keypoints that were corrected since
    (`GET /datasets/{dataset_id}/corrections`) and their confidence: `keypoints`, and where the
    dataset has them `confidence` (1 in frames that came without), `points3d` (NaN in those),
    `times`, `keypoint_names`, `edges`, `view_names`, `image_sizes` (0 where unknown) and `fps`.
    """
    record, known = dataset_changes.corrections_of(store, dataset_id)
    file = capture_file(store, record, known if corrected else ())
    return ranged_response(
        request,
        file.size,
        partial(file.read, lookup.reader_of(store, records.DatasetRecord, record.id)),
        media_type=OCTETS,
        filename=f"{record.id}.npz",
        checksum=file.checksum(),
    )
