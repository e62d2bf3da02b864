"""Every code of a finding: its severity, its effect, and what to do about it."""

from typing import Literal, NamedTuple, get_args

from typing_extensions import TypeAliasType

Severity = TypeAliasType("Severity", Literal["info", "warning"])

CaptureCode = TypeAliasType(
    "CaptureCode",
    Literal[  # of the keypoints alone, before any fit
        "keypoint_never_seen",
        "view_never_seen",
        "keypoint_frozen",
        "views_identical",
        "coordinates_normalised",
        "outside_image",
        "too_few_frames",
        "one_view",
        "no_motion",
        "views_out_of_step",
        "timing_unknown",
        "views_swapped",
        "left_right_swapped",
        "left_right_mended",
        "outliers",
    ],
)
CameraCode = TypeAliasType(
    "CameraCode",
    Literal[  # of the cameras that a fit estimates
        "cameras_not_found",
        "rig_declared_but_moving",
        "calibration_disagrees",
        "calibration_read_otherwise",
        "lens_disagrees",
        "known_length_disagrees",
        "known_distance_not_used",
        "camera_moved",
        "arrangement_not_observable",
        "focal_not_observable",
        "lenses_limit_accuracy",
        "handedness_not_observable",
        "views_opposite",
        "noise_high",
        "lenses_extreme",
    ],
)
CauseCode = TypeAliasType(
    "CauseCode",
    Literal[  # of one view's pixels, named once the cameras show it
        "view_cropped",
        "view_padded",
        "view_scaled",
        "view_stretched",
        "view_mirrored",
        "view_turned",
        "axes_exchanged",
    ],
)
LiftCode = TypeAliasType(
    "LiftCode",
    Literal[  # of new frames
        "rig_not_used",
        "frame_unlike_fit",
        "coordinates_of_another_scale",
        "not_in_room",
    ],
)
FindingCode = CaptureCode | CameraCode | CauseCode | LiftCode


class Entry(NamedTuple):
    """The meaning of a code."""

    severity: Severity
    effect: str
    remedy: str


CATALOGUE: dict[FindingCode, Entry] = {
    "keypoint_never_seen": Entry(
        "warning",
        "No two views show it together (of views that share no keypoints: none shows it), so"
        " lifts have no position for it (null).",
        "Aim two cameras at it, leave it out, or look at what the detector wrote.",
    ),
    "view_never_seen": Entry(
        "warning",
        "This view never shows four keypoints, so its camera is not estimated.",
        "Leave the view out, or look at what the detector wrote.",
    ),
    "keypoint_frozen": Entry(
        "warning",
        "The keypoint stays at one pixel while the subject moves: it was not detected. Fits do"
        " not use it there.",
        "Mark it as not observed there (null, or confidence 0).",
    ),
    "views_identical": Entry(
        "warning",
        "The views have the very same keypoints, so lenses and structures are wrong.",
        "Upload each camera's own keypoints, or leave the copies out.",
    ),
    "coordinates_normalised": Entry(
        "warning",
        "All coordinates lie between about 0 and 1: shares of the image, not pixels. Focal"
        " lengths and noise have no meaning.",
        "Multiply x by the image's width and y by its height.",
    ),
    "outside_image": Entry(
        "warning",
        "Keypoints lie outside the image: its size is wrong, or the detector saw a scaled or"
        " cropped image.",
        "Give the size of the images on which the keypoints were detected.",
    ),
    "too_few_frames": Entry(
        "warning",
        "Too few frames show the subject to learn its shapes well.",
        "Film for longer, or add other poses.",
    ),
    "one_view": Entry(
        "warning",
        "Only one view shows the subject: depth is estimated from the shapes alone.",
        "Add a second, synchronised view.",
    ),
    "no_motion": Entry(
        "warning",
        "The subject hardly moves or turns: neither cameras nor shapes are determined well.",
        "Film a subject that moves about and shows other poses.",
    ),
    "views_out_of_step": Entry(
        "warning",
        "This view is late or early. Unless it was shifted (`applied` 1), fast movements are"
        " smeared and static cameras seem to move.",
        "Synchronise the cameras, or give the dataset's `fps` or `times`: fits and lifts of"
        " datasets then shift the view. Single frames and streams are never shifted.",
    ),
    "timing_unknown": Entry(
        "info",
        "Another offset of this view explains the keypoints about as well; it is taken to be in"
        " step. If it is not, fast movements are smeared.",
        "Start the cameras together, or show all a clap or a jump and give each view's `times`."
        " Repeated movements leave it open.",
    ),
    "views_swapped": Entry(
        "warning",
        "In these frames views were exchanged: static cameras seem to move.",
        "Put them back into the order of the others.",
    ),
    "left_right_swapped": Entry(
        "warning",
        "Left and right keypoints are exchanged in this view, compared with the other views.",
        "Exchange them, or turn off mirroring of its images (`mirror` where files are read).",
    ),
    "left_right_mended": Entry(
        "info",
        "In these frames some left and right keypoints of a view are exchanged. The fit and its"
        " lifts exchange them back (`outlier_probability` 1).",
        "Nothing, if the frames are few; else look at what the detector wrote.",
    ),
    "outliers": Entry(
        "info",
        "Keypoints of these views lie far from where their frame predicts them. Neither the fit"
        " nor its lifts use them (`outlier_probability`).",
        "Nothing, if they are few; else look at what the detector wrote.",
    ),
    "cameras_not_found": Entry(
        "warning",
        "The keypoints determine no cameras: lifts are in weak perspective.",
        "Add a second view, more frames, or a calibration.",
    ),
    "rig_declared_but_moving": Entry(
        "warning",
        "The cameras were declared static, but move: errors and structures are worse.",
        "Fit with `cameras: auto` or `moving`, or look for a bumped tripod or views that are"
        " out of step.",
    ),
    "calibration_disagrees": Entry(
        "warning",
        "The calibration of this view does not explain its keypoints: it was refined (`refused`"
        " 0), or ignored (`refused` 1).",
        "Check whether the camera was moved, zoomed, exchanged or calibrated at another size;"
        " calibrate it again, or leave it out.",
    ),
    "calibration_read_otherwise": Entry(
        "warning",
        "The poses fit only in another convention, which was used: camera to room (`inverted`"
        " 1), axes of graphics (`graphics_axes` 1), another order (`camera_of_view_0` ...).",
        "Give poses from room to camera, x right, y down, z forward, in the order of the views.",
    ),
    "lens_disagrees": Entry(
        "warning",
        "The keypoints contradict a given lens by more than four of its standard deviations."
        " The answer lies between.",
        "Check lens and image size (zoom, video modes and stabilisation crop the sensor), or"
        " leave the lens out.",
    ),
    "known_length_disagrees": Entry(
        "warning",
        "Known length, known distance and calibration give different units. The first of them"
        " was used.",
        "Check the length, the distance and the unit of the calibration's translations.",
    ),
    "known_distance_not_used": Entry(
        "warning",
        "The known distance gives no unit: its cameras are not static relative to each other,"
        " or not determined.",
        "Give a `known_length`, or a `known_distance` of other cameras; if they stood still,"
        " `cameras: static`.",
    ),
    "camera_moved": Entry(
        "warning",
        "A static camera was moved: it fits the others either before these frames or in them.",
        "Fit the frames before and after separately, or with `cameras: moving`.",
    ),
    "arrangement_not_observable": Entry(
        "warning",
        "Two views do not show how these cameras move: carried or zoomed cameras and cropped"
        " images explain the keypoints about as well. Lenses and depths may be wrong beyond"
        " their standard deviations.",
        "Use tripods and leave the zoom alone, or add a third view. Give what is known:"
        " `cameras: static`, the `lenses`.",
    ),
    "focal_not_observable": Entry(
        "warning",
        "The keypoints hardly determine the focal length: distances along the view are as"
        " uncertain.",
        "Give the `lenses` (of a data sheet) or a `calibration`, set `cameras_alike: true` if"
        " they are alike, or film nearer and in more places.",
    ),
    "lenses_limit_accuracy": Entry(
        "warning",
        "Two views determine their lenses only roughly, which costs more than noise does. The"
        " evidence has the expected errors as shares of the subject's height"
        " (`error_by_lenses_of_height`, ...).",
        "Give the `lenses` (of a data sheet), a `calibration` or missing `image_sizes`, set"
        " `cameras_alike: true` if they are alike, or add a third view.",
    ),
    "handedness_not_observable": Entry(
        "warning",
        "The keypoints hardly distinguish structures from their mirror images.",
        "Give the `handedness`, or a calibration.",
    ),
    "views_opposite": Entry(
        "info",
        "Two views look along nearly the same line: together they hardly determine depth.",
        "Place the cameras 60 to 120 degrees apart, or add a view.",
    ),
    "noise_high": Entry(
        "warning",
        "The keypoints are noisy for the size of the subject: structures are as uncertain.",
        "Use a better detector, larger images, or more views.",
    ),
    "lenses_extreme": Entry(
        "warning",
        "The best lenses are unlike real ones: keypoints, or what was given of the cameras, are"
        " probably wrong.",
        "See the other findings; give the image sizes, the `lenses` or a calibration; set"
        " `cameras_alike: false` if the lenses differ.",
    ),
    "view_cropped": Entry(
        "warning",
        "This view's keypoints count from the corner of a window (`x`, `y`). Structures bend"
        " unless `applied` is 1.",
        "Add the corner to the keypoints, or give the window's size if the lens looks through"
        " its middle; or fit with `mend: auto`.",
    ),
    "view_padded": Entry(
        "warning",
        "This view's keypoints are shares of a padded image, multiplied by the unpadded sides."
        " Structures bend unless `applied` is 1.",
        "Multiply by the padded sides and take the padding off; or fit with `mend: auto`.",
    ),
    "view_scaled": Entry(
        "warning",
        "This view's keypoints were found on an image of another size (`scale`). Structures"
        " bend unless `applied` is 1.",
        "Give the size of that image; or fit with `mend: auto`.",
    ),
    "view_stretched": Entry(
        "warning",
        "This view's image was stretched (`fx_over_fy`, at the sides more with a `bend`)."
        " Structures bend unless `applied` is 1.",
        "Turn off the stretching (SuperView and its like), or detect keypoints before it; or"
        " fit with `mend: auto`.",
    ),
    "view_mirrored": Entry(
        "warning",
        "This view's image is a mirror image. Unless `applied` is 1, no camera explains it.",
        "Turn off mirroring in the camera, or undo it where files are read (`mirror`); or fit"
        " with `mend: auto`.",
    ),
    "view_turned": Entry(
        "info",
        "This view's image is upside down or on its side (`degrees`). Its camera is found all"
        " the same; the middle of its lens may be off.",
        "Turn the video first: detectors know people that stand; or fit with `mend: auto`.",
    ),
    "axes_exchanged": Entry(
        "warning",
        "In this view's keypoints x and y are exchanged. Unless `applied` is 1, no camera"
        " explains it.",
        "Write x, to the right, before y, downwards; or fit with `mend: auto`.",
    ),
    "rig_not_used": Entry(
        "warning",
        "The fit's cameras do not explain these frames: each view got a camera of its own.",
        "Check that `views` has the right order, that the views are in step, and that no camera"
        " was moved since.",
    ),
    "frame_unlike_fit": Entry(
        "warning",
        "These frames are unlike all of the fit: their structures are less certain.",
        "Fit a capture that has such poses, or start a fit from this model with them.",
    ),
    "coordinates_of_another_scale": Entry(
        "warning",
        "The coordinates have another scale than those of the fit.",
        "Send pixels of images of the fit's size, not shares of the image.",
    ),
    "not_in_room": Entry(
        "warning",
        "These frames have no place in the room: no static perspective camera determines their"
        " unit. Points and cameras are empty.",
        "Ask for the canonical frame of reference, or lift with `refine: full` and views of two"
        " static cameras.",
    ),
}
CODES: tuple[FindingCode, ...] = tuple(
    code for group in get_args(FindingCode) for code in get_args(group.__value__)
)
