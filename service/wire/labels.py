"""The JSON form of images that are worth labelling, and labels as files of other tools."""

import shutil
import zipfile
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, Self

import numpy as np
from fewview.writers.labels import Labels, ViewLabels, write_labels
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from typing_extensions import TypeAliasType

from models.labelling import worth
from models.labelling.accepted import Accepted, Sizes
from models.labelling.filmed import Filmed
from service.wire.skeletons import Skeleton

LabelFormat = TypeAliasType("LabelFormat", Literal["dlc", "dlc-machine", "coco", "lightning-pose"])
LabelSource = TypeAliasType("LabelSource", Literal["reprojections", "keypoints"])
LabelledImages = TypeAliasType("LabelledImages", Literal["worth-labelling", "all"])
LabelReasonCode = TypeAliasType(
    "LabelReasonCode", Literal["outlier", "disagreement", "missed", "unlike_fit"]
)
STAMP = (1980, 1, 1, 0, 0, 0)  # of all files in a ZIP: the same labels give the same bytes
Frames = list[NDArray[np.int64]]


class LabelReason(BaseModel):
    """Why an image is worth labelling."""

    code: LabelReasonCode = Field(
        description="`outlier`: detected where the keypoint cannot be; `disagreement`: detected "
        "away from where all views together show it; `missed`: not detected though other views "
        "see it well; `unlike_fit`: a pose unlike all others, or a frame unlike the fit."
    )
    keypoints: list[int] = Field(description="Which keypoints; all if empty.")
    evidence: dict[str, float] = Field(
        description="The numbers behind it, the largest of the keypoints: `error_px` from "
        "detection to reprojection, `noises` the same in standard deviations of the keypoint's "
        "noise in this view, `probability` of an outlier, `views` others that see it, "
        "`distance_ratio` to the nearest other pose, over the usual such distance."
    )


class ImageWorthLabelling(BaseModel):
    """A frame of a view that a human should look at."""

    view: int
    view_name: str
    frame: int = Field(description="Frame of the view's own film, counted from 0.")
    moment: int | None = Field(
        description="Frame of the reconstruction that the image shows: another one where the view "
        "is late; null if none."
    )
    score: float = Field(
        description="How many keypoints the detector probably got wrong or missed in the image, "
        "and one more for a pose unlike all others."
    )
    reasons: list[LabelReason] = Field(description="Those that count most first.")


class FitLabels(BaseModel):
    """The images of a fitted dataset that would teach the detector most, best first."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "fit_id": "fit_01m7yspf3gqz6cz1v8e7ch3y7c",
                "dataset_id": "ds_01m7yspdypmt22jq6npfg62xe5",
                "images": [
                    {
                        "view": 1,
                        "view_name": "cam2",
                        "frame": 118,
                        "moment": 118,
                        "score": 1.87,
                        "reasons": [
                            {
                                "code": "outlier",
                                "keypoints": [3],
                                "evidence": {"error_px": 41.2, "probability": 0.997},
                            },
                            {"code": "missed", "keypoints": [7, 8], "evidence": {"views": 3.0}},
                        ],
                    }
                ],
                "candidates": 12,
                "noise_px": [1.1, 1.4, 1.2, 1.3],
            }
        }
    )

    fit_id: str
    dataset_id: str
    images: list[ImageWorthLabelling]
    candidates: int = Field(
        description="How many images are worth labelling, with all that are like those listed."
    )
    noise_px: list[float | None] = Field(
        description="Standard deviation of detections about the fit in each view, pixels: median "
        "over its keypoints; null for a view without accepted ones."
    )

    @classmethod
    def of(
        cls,
        fit_id: str,
        dataset_id: str,
        ranking: worth.Ranking,
        names: list[str],
        noise: NDArray[np.float64],
    ) -> Self:
        """Return the JSON form of a ranking, with the noise (K, P) of keypoints."""
        known = [view[np.isfinite(view)] for view in noise]
        return cls(
            fit_id=fit_id,
            dataset_id=dataset_id,
            images=[
                ImageWorthLabelling(
                    view_name=names[image.view],
                    reasons=[
                        LabelReason(code=code, keypoints=list(keypoints), evidence=evidence)
                        for code, keypoints, evidence in image.reasons
                    ],
                    **{name: getattr(image, name) for name in ("view", "frame", "moment", "score")},
                )
                for image in ranking.images
            ],
            candidates=ranking.candidates,
            noise_px=[float(np.median(view)) if len(view) else None for view in known],
        )


def frames_worth(
    ranking: worth.Ranking, filmed: Filmed, corrected: NDArray[np.bool_], *, together: bool
) -> Frames:
    """Return the frames of each view that a ranking names, and those with corrections.

    Parameters
    ----------
    corrected
        (N, K, P) keypoints that a human put right or removed.
    together
        Whether every view has a frame of each moment that is named in any view; moments that some
        view did not film are left out.
    """
    views = filmed.moments.shape[1]
    mended = corrected.any(-1)
    if not together:
        named = [[i.frame for i in ranking.images if i.view == view] for view in range(views)]
        return with_corrected([np.array(frames, np.int64) for frames in named], corrected)
    shown_by_hand = filmed.moments[mended]
    by_hand = np.rint(shown_by_hand[np.isfinite(shown_by_hand)]).astype(np.int64).tolist()
    moments = sorted({i.moment for i in ranking.images if i.moment is not None} | {*by_hand})
    shown = filmed.frames[moments]
    shown = np.rint(shown[np.isfinite(shown).all(1)]).astype(np.int64)
    return list(shown.T)


def with_corrected(frames: Frames, corrected: NDArray[np.bool_]) -> Frames:
    """Return frames of each view, in their order, and those where something is corrected."""
    return [
        np.union1d(chosen, np.flatnonzero(corrected[:, view].any(-1))).astype(np.int64)
        for view, chosen in enumerate(frames)
    ]


def frames_of_all(accepted: Accepted, most: int | None) -> Frames:
    """Return the frames of each view that have a label, or as many of them, evenly spread."""
    frames = []
    for view in range(accepted.weights.shape[1]):
        labelled = np.flatnonzero((accepted.weights[:, view] > 0).any(-1))
        if most is not None and len(labelled) > most:
            labelled = labelled[np.linspace(0, len(labelled) - 1, most).round().astype(np.int64)]
        frames.append(labelled)
    return frames


def labels_of(
    accepted: Accepted,
    frames: Frames,
    *,
    view_names: list[str],
    sizes: Sizes,
    skeleton: Skeleton,
    least_weight: float,
    scorer: str,
) -> Labels:
    """Return the accepted keypoints of some frames of each view as labels."""
    enough = (accepted.weights > 0) & (accepted.weights >= least_weight)
    keypoints = np.where(enough[..., None], accepted.keypoints, np.nan)
    weights = np.where(enough, accepted.weights, 0.0)
    names = skeleton.keypoint_names
    count = weights.shape[2]
    return Labels(
        views=tuple(
            ViewLabels(
                name=view_names[view],
                frames=chosen,
                keypoints=keypoints[chosen, view],
                weights=weights[chosen, view],
                detected=accepted.detected[chosen, view],
                size=sizes[view],
            )
            for view, chosen in enumerate(frames)
        ),
        keypoint_names=tuple(names or (f"point{place + 1}" for place in range(count))),
        edges=tuple((first, second) for first, second in skeleton.edges),
        scorer=scorer,
        length=len(weights),
    )


def labels_zip(labels: Labels, format: LabelFormat) -> bytes:
    """Return a ZIP of the files of a format."""
    content = BytesIO()
    with TemporaryDirectory() as place, zipfile.ZipFile(content, "w") as archive:
        for file in write_labels(Path(place), labels, format):
            about = zipfile.ZipInfo(file.relative_to(place).as_posix(), STAMP)
            about.compress_type = zipfile.ZIP_DEFLATED
            with file.open("rb") as source, archive.open(about, "w") as target:
                shutil.copyfileobj(source, target)
    return content.getvalue()
