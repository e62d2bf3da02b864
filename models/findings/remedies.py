"""The fields in which the remedies of findings can be given.

Apart from the catalogue: what makes findings, and compiled functions near it, need none of this.
"""

from typing import Literal

from typing_extensions import TypeAliasType

from models.findings.catalogue import FindingCode

RemedyField = TypeAliasType(
    "RemedyField",
    Literal[
        "fps",  # of a dataset
        "image_sizes",
        "mirror",  # where files are read
        "mend",  # of a fit
        "lenses",
        "calibration",
        "known_length",
        "known_distance",
        "handedness",
        "cameras",
        "cameras_alike",
        "from_model",
        "frame",  # of lifts
        "refine",
        "views",
    ],
)

REMEDY_FIELDS: dict[FindingCode, tuple[RemedyField, ...]] = {
    "outside_image": ("image_sizes",),
    "views_out_of_step": ("fps",),
    "left_right_swapped": ("mirror",),
    "cameras_not_found": ("calibration",),
    "rig_declared_but_moving": ("cameras",),
    "calibration_disagrees": ("calibration",),
    "calibration_read_otherwise": ("calibration",),
    "lens_disagrees": ("lenses", "image_sizes"),
    "known_length_disagrees": ("known_length", "known_distance", "calibration"),
    "known_distance_not_used": ("known_length", "known_distance", "cameras"),
    "camera_moved": ("cameras",),
    "arrangement_not_observable": ("cameras", "lenses"),
    "focal_not_observable": ("lenses", "calibration", "cameras_alike"),
    "lenses_limit_accuracy": ("lenses", "calibration", "image_sizes", "cameras_alike"),
    "handedness_not_observable": ("handedness", "calibration"),
    "lenses_extreme": ("image_sizes", "lenses", "calibration", "cameras_alike"),
    "view_cropped": ("mend", "image_sizes"),
    "view_padded": ("mend",),
    "view_scaled": ("mend", "image_sizes"),
    "view_stretched": ("mend",),
    "view_mirrored": ("mend", "mirror"),
    "view_turned": ("mend",),
    "axes_exchanged": ("mend",),
    "rig_not_used": ("views",),
    "frame_unlike_fit": ("from_model",),
    "not_in_room": ("frame", "refine"),
}
