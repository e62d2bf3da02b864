"""What a fit can be told. Imports no torch, so that an API can show and check it cheaply."""

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

from models.settings.calibration import Alike, Camera, Keypoint, KnownLength, as_index
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
Synchronise = TypeAliasType("Synchronise", Literal["auto", "off"])
Index = Annotated[int, Field(ge=0)]

LEARNING_RATES = ", ".join(
    f"{its.learning_rate:g} for `{name}`" for name, its in PRIOR_SETTINGS.items()
)
WARM_STEPS = 1100  # of a fit that starts from a model, unless it was told otherwise


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
    batch_size: int = Field(default=64, ge=1, le=512, description="Frames in one step.")
    learning_rate: float | None = Field(
        default=None,
        validate_default=True,
        gt=0,
        le=1,
        description=(
            "Adam's step size at the start; it falls to zero along half a cosine. Null, which is"
            f" replaced by it: what suits the prior, {LEARNING_RATES}."
        ),
    )
    budget_s: float | None = Field(
        default=None,
        ge=1,
        le=7 * 24 * 3600,
        description=(
            "Seconds that training may take, over all attempts, finding the cameras included. The"
            " fit is laid out for this time, as far as `steps` and what else it was told allow."
            " Null: as long as its steps take."
        ),
    )
    early_stopping: bool = Field(
        default=False,
        description=(
            "Hold out a twentieth of the frames, from 200 on, and come to an end when predicting"
            " one of their views from the others gets no better."
        ),
    )
    distillation: bool = Field(
        default=True,
        description=(
            "Let what several views of a frame agree on teach the network about frames with fewer."
            " Off: the paper's fit, from the reprojection error alone."
        ),
    )
    denoising: bool = Field(
        default=True,
        description=(
            "Remove noise from the keypoints before anything else, in the fit and in lifts, where"
            " the capture shows that it is strong, and white once it is divided by the level of"
            " each keypoint and view (cameras at rest, 40 frames or more)."
            " Frames of datasets with `fps` or `times` are smoothed in time instead, in fits, their"
            " reconstructions and lift jobs, also if cameras move."
        ),
    )
    outlier_rejection: bool = Field(
        default=True,
        description=(
            "Leave out keypoints that lie where the rest of their frame says that they cannot be,"
            " in the fit and in lifts (40 frames or more), and put left and right keypoints right"
            " that were taken for each other in single views."
        ),
    )
    bone_lengths: bool = Field(
        default=True,
        description=(
            "Hold edges of the skeleton at their lengths in refined lifts, where noise was removed"
            " and the capture shows that they keep them."
        ),
    )
    synchronise: Synchronise = Field(
        default="auto",
        description=(
            "`auto`: views that show every moment later than the others are found, and shifted if"
            " the dataset tells `fps` or `times`; without these they are only reported. `off`: the"
            " views are taken as they are, save for `times` that differ between views."
        ),
    )
    refine: Refine = Field(
        default="auto",
        description=(
            "Perspective refinement of every frame after the network: `auto` where the residuals"
            " say that it helps, `full` wherever it can be computed, `off` never (weak perspective,"
            " as in the paper). Also what lifts do unless they say otherwise."
        ),
    )
    cameras: Arrangement = Field(
        default="auto",
        description=(
            "`static`: the cameras rest relative to each other; `moving`: each may move from frame"
            " to frame; `auto`: found from the keypoints, view by view."
        ),
    )
    cameras_alike: Alike = Field(
        default="auto",
        description=(
            "Whether lenses that are not told are alike, as those of cameras of one model set to"
            " the same zoom: `true`, `false`, or `auto`: alike, of several kinds or unlike, as the"
            " keypoints say of three or more cameras at rest. Other cameras count as alike then."
        ),
    )
    calibration: tuple[Camera | None, ...] | None = Field(
        default=None,
        max_length=64,
        description="What is known of the cameras, one entry per view; null where nothing is.",
    )
    known_length: KnownLength | None = Field(
        default=None, description="A measured distance in the subject: results get its unit."
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
    def _suits_the_prior(cls, rate: float | None, told: ValidationInfo) -> float | None:
        prior = told.data.get("prior")  # there is none if it is not valid
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

    @property
    def hand(self) -> tuple[int, int, int, int] | None:
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
    """Fill in what a fit that starts from a model was not told, for a model fitted so.

    What it was told of `ARCHITECTURE` must be as in the model.
    """
    suits = {field: getattr(source, field) for field in ARCHITECTURE} | {"steps": WARM_STEPS}
    told = {name: getattr(config, name) for name in config.model_fields_set}
    return FitConfig.model_validate(suits | told)
