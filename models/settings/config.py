"""The configuration of a fit. Imports no torch, so that an API can show and check it quickly."""

from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)
from typing_extensions import TypeAliasType

from models.settings.calibration import (
    Alike,
    Camera,
    Keypoint,
    KnownDistance,
    KnownLength,
    as_index,
)
from models.settings.lenses import Lens
from models.settings.priors import (
    ARCHITECTURE,
    PRIOR_SETTINGS,
    DictionarySizes,
    MlpSizes,
    PriorName,
    check_dictionary_sizes,
)

Refine = TypeAliasType("Refine", Literal["auto", "off", "full"])
Arrangement = TypeAliasType("Arrangement", Literal["auto", "moving", "static"])
Automatic = TypeAliasType("Automatic", Literal["auto", "off"])  # of keypoints, before a fit
Index = Annotated[int, Field(ge=0)]

LEARNING_RATES = ", ".join(
    f"{its.learning_rate:g} for `{name}`" for name, its in PRIOR_SETTINGS.items()
)
LEAST_BATCH, MOST_BATCH = 32, 64  # frames in one step, unless `batch_size` is given
BATCHES = 8  # of which a small capture consists
WARM_STEPS = 1100  # of a fit that starts from a model, unless `steps` is given


class FitConfig(BaseModel):
    """Everything that decides the outcome of a fit besides the keypoints."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    prior: PriorName = Field(
        default="hierarchical",
        description=(
            "The shape prior: `hierarchical` is the paper's multi-layer block-sparse dictionary,"
            " sized by `dictionary_sizes`; `mlp` a plain encoder and decoder, sized by `mlp`."
        ),
    )
    dictionary_sizes: DictionarySizes = Field(
        default=(128, 32),
        min_length=1,
        max_length=12,
        description=(
            "Atoms in the dictionary of each layer of the prior `hierarchical`, from the keypoints"
            " inwards, never increasing. The last one is the length of the code that describes a"
            " structure."
        ),
    )
    mlp: MlpSizes = Field(
        default=MlpSizes(), description="Sizes of the encoder and decoder of the prior `mlp`."
    )
    steps: int = Field(
        default=4500,
        ge=1,
        le=1_000_000,
        description="Optimiser steps; each sees one batch. Where geometry finds static cameras"
        " before the first step, two thirds of them are taken, of few frames a third, but no"
        " fewer than 1000.",
    )
    batch_size: int | None = Field(
        default=None,
        ge=1,
        le=512,
        description=(
            f"Frames in one step. Null: an eighth of the frames of the fit, but {LEAST_BATCH} at"
            f" least and {MOST_BATCH} at most."
        ),
    )
    learning_rate: float | None = Field(
        default=None,
        validate_default=True,
        gt=0,
        le=1,
        description=(
            "Adam's step size at the start; it falls to zero along half a cosine. Null is replaced"
            f" by the default of the prior: {LEARNING_RATES}."
        ),
    )
    budget_s: float | None = Field(
        default=None,
        ge=1,
        le=7 * 24 * 3600,
        description=(
            "Seconds that training may take, over all attempts, including the estimation of the"
            " cameras. The fit is planned for this time, as far as `steps` and the other settings"
            " allow. Null: no limit."
        ),
    )
    early_stopping: bool = Field(
        default=False,
        description=(
            "End the fit when the network no longer improves at predicting one view of a held-out"
            " frame from the others. A fit of fewer than 200 frames holds out none, and does not"
            " end early."
        ),
    )
    distillation: bool = Field(
        default=True,
        description=(
            "Teach the network with structures estimated from several views of a frame, so that it"
            " needs fewer. Off: the paper's fit, from the reprojection error alone."
        ),
    )
    denoising: bool = Field(
        default=True,
        description=(
            "Remove noise from the keypoints before anything else, in the fit and in lifts, if it"
            " is strong in the capture, and white once it is divided by the level of each keypoint"
            " and view (static cameras, 40 frames or more). Frames of datasets with `fps` or"
            " `times` are smoothed in time instead, in fits, their reconstructions and lift jobs,"
            " also if cameras move."
        ),
    )
    outlier_rejection: bool = Field(
        default=True,
        description=(
            "Leave out keypoints that lie far from where the other keypoints of their frame predict"
            " them, in the fit and in lifts (40 frames or more). Left and right keypoints that were"
            " taken for each other in single views are exchanged back."
        ),
    )
    bone_lengths: bool = Field(
        default=True,
        description=(
            "Hold edges of the skeleton at their lengths in refined lifts, if noise was removed"
            " and their lengths are constant in the capture."
        ),
    )
    synchronise: Automatic = Field(
        default="auto",
        description=(
            "`auto`: views that show every moment later than the others are found. They are shifted"
            " if the dataset has `fps` or `times`, otherwise only reported. `off`: the views are"
            " used as they are, except for `times` that differ between views."
        ),
    )
    mend: Automatic = Field(
        default="off",
        description=(
            "Views whose pixels are not what they seem (cropped, padded, scaled, stretched,"
            " mirrored, turned, x and y exchanged) are found once the cameras show it. `auto`: the"
            " fit undoes it before anything else, and so do lifts of its model; cameras, errors and"
            " noise are then of the mended pixels. `off`: it is only reported."
        ),
    )
    refine: Refine = Field(
        default="auto",
        description=(
            "Perspective refinement of every frame after the network: `auto` unless it explains a"
            " frame's keypoints worse than the network by more than a quarter, `full` wherever it"
            " can be computed, `off` never (weak perspective, as in the paper). It is also the"
            " default of lifts."
        ),
    )
    cameras: Arrangement = Field(
        default="auto",
        description=(
            "`static`: the cameras do not move relative to each other; `moving`: each may move from"
            " frame to frame; `auto`: estimated from the keypoints, view by view."
        ),
    )
    cameras_alike: Alike = Field(
        default="auto",
        description=(
            "Whether lenses that are not given are alike, as those of cameras of one model set to"
            " the same zoom: `true`, `false`, or `auto`. With `auto`, lenses are alike, of several"
            " kinds or unlike, as estimated from the keypoints; where these do not show it, and"
            " where some cameras move and others are static, they count as alike."
        ),
    )
    calibration: tuple[Camera | None, ...] | None = Field(
        default=None,
        max_length=64,
        description="Given cameras, one entry per view; null where nothing is known.",
    )
    lenses: tuple[Lens | None, ...] | None = Field(
        default=None,
        min_length=1,
        max_length=64,
        description=(
            "What is known of the lenses without a calibration: an entry per view, null where"
            " nothing is known, or one entry for all views. The keypoints improve it."
        ),
    )
    known_length: KnownLength | None = Field(
        default=None, description="A measured distance in the subject: results get its unit."
    )
    known_distance: KnownDistance | None = Field(
        default=None,
        description=(
            "A measured distance between two cameras that are static: results get its unit, if"
            " there is no `known_length`."
        ),
    )
    handedness: tuple[Keypoint, Keypoint, Keypoint, Keypoint] | None = Field(
        default=None,
        description=(
            "Four keypoints a, b, c, d with a positive volume (b-a) x (c-a) . (d-a) in most"
            " frames, seen in a right-handed frame: decides between a structure and its mirror"
            " image. Without it perspective decides. Indices, or names of the dataset's skeleton;"
            " kept as indices."
        ),
    )
    seed: int = Field(
        default=0,
        ge=0,
        le=2**32 - 1,
        description="Decides the initial weights, the order of the frames and the augmentation.",
    )
    pck_threshold: float = Field(
        default=0.1,
        gt=0,
        le=1e9,
        description=(
            "Distance below which a keypoint counts as correct when a ground truth is given,"
            " in the unit of that truth (the paper's is 10 cm)."
        ),
    )

    @field_validator("learning_rate")
    @classmethod
    def _suits_the_prior(cls, rate: float | None, info: ValidationInfo) -> float | None:
        prior = info.data.get("prior")  # missing if it is not valid
        return PRIOR_SETTINGS[prior].learning_rate if rate is None and prior is not None else rate

    @model_validator(mode="after")
    def _sizes_are_those_of_the_prior(self) -> "FitConfig":
        check_dictionary_sizes(self.dictionary_sizes)
        for name, settings in PRIOR_SETTINGS.items():
            default = type(self).model_fields[settings.sizes].default
            if name != self.prior and getattr(self, settings.sizes) != default:
                raise ValueError(
                    f"{settings.sizes} is for the prior {name!r}, got the prior {self.prior!r};"
                    f" leave {settings.sizes} out, or set prior to {name!r}"
                )
        return self

    def batch_of(self, frames: int) -> int:
        """Return how many frames one step of a fit to so many `frames` takes, if it has them."""
        return self.batch_size or min(max(frames // BATCHES, LEAST_BATCH), MOST_BATCH)

    @property
    def corners(self) -> tuple[int, int, int, int] | None:
        """Indices of the four keypoints that decide the handedness."""
        if self.handedness is None:
            return None
        a, b, c, d = self.handedness
        return as_index(a), as_index(b), as_index(c), as_index(d)

    @property
    def sizes(self) -> Any:
        """The sizes of the prior that was chosen."""
        return getattr(self, PRIOR_SETTINGS[self.prior].sizes)


def warm(config: FitConfig, source: FitConfig) -> FitConfig:
    """Return the configuration of a fit that starts from a model fitted with `source`.

    Fields that are not set take the model's `ARCHITECTURE`, and `WARM_STEPS`. Fields of
    `ARCHITECTURE` that are set must agree with the model.
    """
    suits = {field: getattr(source, field) for field in ARCHITECTURE} | {"steps": WARM_STEPS}
    given = {name: getattr(config, name) for name in config.model_fields_set}
    return FitConfig.model_validate(suits | given)
