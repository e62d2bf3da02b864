"""Skeletons that are known by name, for who names the keypoints of a dataset."""

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict

from service.http.errors import problems
from service.wire.skeletons import KnownSkeleton, known_skeletons

router = APIRouter(prefix="/skeletons", tags=["datasets"])


class SkeletonList(BaseModel):
    """All of them."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "items": [
                    {
                        "name": "face-5",
                        "title": "Face",
                        "keypoint_names": ["left_eye", "right_eye", "nose"],
                        "edges": [[2, 0], [2, 1]],
                    }
                ]
            }
        }
    )

    items: list[KnownSkeleton]


@router.get("", responses=problems())
async def list_skeletons() -> SkeletonList:
    """List the skeletons that are known by name, those of people, hands, animals and faces.

    One of them can be given as `skeleton_name` with files, or become the `skeleton` of a dataset.
    """
    return SkeletonList(items=known_skeletons())
