"""Corrections: keypoints of a dataset that were put right or removed, beside what was detected."""

from functools import partial
from typing import Annotated, Any, Self

from fastapi import APIRouter, Query, Request, Response
from pydantic import ConfigDict

from service.http.dependencies import Identifier, StoreDep
from service.http.errors import BODY_PROBLEMS, problems
from service.http.operations import UNCHANGED, request_body
from service.http.preconditions import etag_of, tagged
from service.http.uploads import UploadBody
from service.wire.corrections import Correction, CorrectionsChange, CorrectionsState
from service.wire.json_bodies import read_json
from store import corrections, dataset_changes, records

router = APIRouter(prefix="/datasets", tags=["datasets"])


class DatasetCorrections(CorrectionsState):
    """All corrections of a dataset, by frame, view and keypoint."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "count": 2,
                "checksum": f"sha256:{'9c1f' * 16}",
                "items": [
                    {"frame": 118, "view": 1, "keypoint": 3, "position": [412.5, 230.0]},
                    {"frame": 119, "view": 1, "keypoint": 3, "position": None},
                ],
            }
        }
    )

    items: list[Correction]

    @classmethod
    def listed(cls, record: records.DatasetRecord, known: corrections.Corrections) -> Self:
        """Return the corrections of a record."""
        state = CorrectionsState.of(record)
        return cls(**state.model_dump(), items=[Correction.of(each) for each in known])


@router.get(
    "/{dataset_id}/corrections",
    response_model=DatasetCorrections,
    responses=problems("not_found") | UNCHANGED,
)
def list_corrections(
    dataset_id: Identifier, store: StoreDep, request: Request, response: Response
) -> Any:
    """List the keypoints of a dataset that were corrected or removed."""
    record, known = dataset_changes.corrections_of(store, dataset_id)
    return tagged(request, response, record, partial(DatasetCorrections.listed, known=known))


@router.patch(
    "/{dataset_id}/corrections",
    responses=problems(*BODY_PROBLEMS, "not_found"),
    openapi_extra=request_body(CorrectionsChange),
)
def correct_keypoints(
    dataset_id: Identifier,
    upload: UploadBody,
    store: StoreDep,
    response: Response,
    dry_run: Annotated[
        bool, Query(description="Change nothing, and answer what there would be.")
    ] = False,
) -> CorrectionsState:
    """Correct or remove keypoints of a dataset, and undo earlier corrections; all or nothing.

    What was detected stays as it is. Whoever reads the keypoints from now on has the corrections:
    new fits and lifts, findings, captures and labels. A corrected keypoint counts as certain. Fits
    and lifts that are there keep to the corrections that they were made with. The same request
    again changes nothing.
    """
    asked = read_json(upload, CorrectionsChange)
    record = dataset_changes.correct(
        store,
        dataset_id,
        [each.stored() for each in asked.correct],
        [each.place() for each in asked.undo],
        dry_run=dry_run,
    )
    if not dry_run:
        response.headers["ETag"] = etag_of(record)
    return CorrectionsState.of(record)
