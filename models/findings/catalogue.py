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
        "Never seen by two views in the same frame, so lifts have no position for it (null). In a"
        " capture whose views share no keypoints: never seen by any view.",
        "Aim the cameras so that two of them show the keypoint, leave it out, or look at what the"
        " detector wrote for it.",
    ),
    "view_never_seen": Entry(
        "warning",
        "This view never shows four keypoints or more, so its camera is not estimated.",
        "Leave the view out, or look at what the detector wrote for it.",
    ),
    "keypoint_frozen": Entry(
        "warning",
        "The keypoint stays at one pixel, to the last digit, while the subject moves: the detector"
        " did not find it. Fits do not use it there.",
        "Mark it as not observed (null, or confidence 0) where the detector did not find it.",
    ),
    "views_identical": Entry(
        "warning",
        "The views have the very same keypoints. The fit takes them for cameras that agree, and"
        " finds wrong lenses and structures.",
        "Upload each camera's own keypoints, or leave the copies out.",
    ),
    "coordinates_normalised": Entry(
        "warning",
        "All coordinates lie between about 0 and 1, so they are shares of the image, not pixels:"
        " focal lengths and noise have no meaning.",
        "Multiply x by the image's width and y by its height, in pixels.",
    ),
    "outside_image": Entry(
        "warning",
        "Keypoints lie outside the image: the image size is not that of these keypoints, or the"
        " detector was run on a scaled or cropped image.",
        "Give the size of the images on which the keypoints were detected.",
    ),
    "too_few_frames": Entry(
        "warning",
        "Too few frames show the subject to learn its shapes well.",
        "Film for longer, or add frames that show other poses.",
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
        "A view shows every moment later or earlier than the others. Where it was not shifted"
        " (`applied` is 0), fast movements are smeared and static cameras seem to move.",
        "Synchronise the cameras, or give the dataset's `fps` or `times`: fits and lifts of"
        " datasets then shift the view (`synchronise: auto`). Frames that are lifted one by one or"
        " in a stream are never shifted: send them in step.",
    ),
    "timing_unknown": Entry(
        "info",
        "The keypoints do not show whether this view is in step with the others: another offset"
        " explains them about as well. It counts as in step, and is not shifted. If it is late,"
        " fast movements are smeared and static cameras seem to move.",
        "Start the cameras together, or show a clap or a jump to all of them and give the `times`"
        " of each view. Steady steps and other movements that repeat leave it open.",
    ),
    "views_swapped": Entry(
        "warning",
        "In these frames views were exchanged: static cameras seem to move.",
        "Put the views of these frames back into the order of the others.",
    ),
    "left_right_swapped": Entry(
        "warning",
        "Left and right keypoints are exchanged in this view, compared with the other views.",
        "Exchange left and right in this view, or turn off mirroring of its images (`mirror` where"
        " files are read).",
    ),
    "left_right_mended": Entry(
        "info",
        "In these frames some left and right keypoints of a view are exchanged, compared with the"
        " other views. The fit and its lifts exchange them back; their `outlier_probability` in a"
        " lift is 1.",
        "Nothing, if the frames are few; else look at what the detector wrote for these views.",
    ),
    "outliers": Entry(
        "info",
        "Keypoints of these views lie far from where the other keypoints of their frame predict"
        " them. Neither the fit nor its lifts use them; a lift marks them in"
        " `outlier_probability`.",
        "Nothing, if they are few; else look at what the detector wrote for these views.",
    ),
    "cameras_not_found": Entry(
        "warning",
        "The keypoints do not determine any cameras: lifts are in weak perspective.",
        "Add a second view, more frames, or a calibration.",
    ),
    "rig_declared_but_moving": Entry(
        "warning",
        "The cameras were declared static, but according to the keypoints they move. Reprojection"
        " errors and structures are worse for it.",
        "Fit with `cameras: auto` or `moving`, or look for the cause, such as a bumped tripod or"
        " views that are out of step.",
    ),
    "calibration_disagrees": Entry(
        "warning",
        "The calibration of this view does not explain its keypoints. It was refined if it is"
        " slightly off (`refused` 0), and ignored and estimated if it is far off (`refused` 1).",
        "Check whether the camera was moved, zoomed, exchanged or calibrated at another image"
        " size. Calibrate it again, or leave its calibration out.",
    ),
    "calibration_read_otherwise": Entry(
        "warning",
        "The given poses explain the keypoints only in another convention, in which they were used:"
        " from the camera to the room (`inverted` 1), with the axes of graphics (`graphics_axes`"
        " 1), or with the cameras in another order (`camera_of_view_0` ...).",
        "Give poses that transform from the room to the camera, x right, y down, z forward, and the"
        " cameras in the order of the views.",
    ),
    "lens_disagrees": Entry(
        "warning",
        "The keypoints contradict what was given of the lenses of these views by more than four of"
        " its standard deviations. The answer lies between the two; the evidence has both, in"
        " pixels.",
        "Check the lens: 35 mm equivalents are of the whole sensor, and zoom, video modes and"
        " stabilisation crop it. Check the image sizes, too, or leave the lens out.",
    ),
    "known_length_disagrees": Entry(
        "warning",
        "What was measured gives another unit than the calibration, or the known length another"
        " than the known distance. The known length was used; without one, the known distance.",
        "Check the length, the distance and the unit of the calibration's translations.",
    ),
    "known_distance_not_used": Entry(
        "warning",
        "The known distance gives no unit: its cameras are not static relative to each other, or"
        " the keypoints do not determine how far apart they are.",
        "Give a `known_length` instead, or a `known_distance` of two other cameras; if the cameras"
        " did stand still, fit with `cameras: static`.",
    ),
    "camera_moved": Entry(
        "warning",
        "An otherwise static camera was moved: it fits the other cameras either before these frames"
        " or in them, not in both.",
        "Fit the frames before and after the move separately, or with `cameras: moving`.",
    ),
    "arrangement_not_observable": Entry(
        "warning",
        "Two views do not show how these cameras move: a camera that is carried, pans or zooms,"
        " and images cropped about the subject explain the keypoints about as well, with other"
        " lenses and depths. Of drawn captures like this one, every second was off by more than"
        " three times what noise explains, and the standard deviations do not show it.",
        "Put the cameras on tripods and leave them and their zoom alone, or add a third view. Give"
        " what is known: `cameras: static`, the `lenses`.",
    ),
    "focal_not_observable": Entry(
        "warning",
        "The keypoints hardly determine the focal length (a far or flat subject, or few frames). It"
        " is estimated with a wide standard deviation, and distances along the view are as"
        " uncertain.",
        "Give what is known of the lenses (`lenses`: of a phone's data sheet, to 5 %), or a"
        " `calibration`; set `cameras_alike: true` if the lenses are alike, or film the subject"
        " nearer and in more places.",
    ),
    "lenses_limit_accuracy": Entry(
        "warning",
        "Two views determine their lenses only roughly. This makes larger errors of the structures"
        " than the noise of the keypoints does. The evidence gives the mean error that is expected"
        " from each, as a share of the subject's height (`error_by_lenses_of_height`,"
        " `error_by_noise_of_height`), what lenses known to 5 % would leave"
        " (`error_with_lenses_to_5_percent`), and several likely focal lengths if there are"
        " (`likely_focal_1_in_sides` and so on).",
        "Give what is known of the lenses (`lenses`: of a phone's data sheet, to 5 %), or a"
        " `calibration`; give `image_sizes` that are missing, set `cameras_alike: true` if the"
        " lenses are alike, or add a third view.",
    ),
    "handedness_not_observable": Entry(
        "warning",
        "The keypoints hardly distinguish the structures from their mirror images.",
        "Give the `handedness`, or a calibration.",
    ),
    "views_opposite": Entry(
        "info",
        "Two views look along nearly the same line, from the same side or from opposite sides"
        " (`degrees` between their directions): together they hardly determine depth.",
        "Place the cameras 60 to 120 degrees apart, or add a view.",
    ),
    "noise_high": Entry(
        "warning",
        "The keypoints are noisy for the size of the subject: structures are as uncertain.",
        "Use a better detector, larger images, or more views.",
    ),
    "lenses_extreme": Entry(
        "warning",
        "The lenses that explain the keypoints best are unlike real ones: the keypoints or what was"
        " given of the cameras is probably wrong. No fault of one view's pixels was found to"
        " explain it.",
        "Look at the other findings, give the image sizes, what is known of the lenses (`lenses`)"
        " or a calibration, or set `cameras_alike: false` if the lenses differ.",
    ),
    "view_cropped": Entry(
        "warning",
        "This view's keypoints count from the corner of a window (`x`, `y`, pixels in the whole"
        " image, beside the other views), not from that of the image: the middle of its lens is"
        " not where it was expected. Unless it is undone (`applied` 1), structures bend.",
        "Add the corner to the view's keypoints, or give the window's size as its image size if"
        " the lens looks through its middle. Or fit with `mend: auto`, which undoes it in the"
        " fit and in lifts of its model (`applied` 1).",
    ),
    "view_padded": Entry(
        "warning",
        "This view's keypoints are shares of an image that was padded to another shape,"
        " multiplied by the sides of the image without the padding: x and y have scales of their"
        " own (`fx_over_fy`). Unless it is undone (`applied` 1), structures bend.",
        "Multiply the shares by the sides of the padded image, and take the padding off. Or fit"
        " with `mend: auto`, which undoes it in the fit and in lifts of its model (`applied` 1).",
    ),
    "view_scaled": Entry(
        "warning",
        "This view's keypoints were found on an image of another size (`scale` of the given or"
        " the usual one). Unless it is undone (`applied` 1), the lens is taken for another one,"
        " and structures bend.",
        "Give the size of the image on which its keypoints were found. Or fit with `mend:"
        " auto`, which undoes it in the fit and in lifts of its model (`applied` 1).",
    ),
    "view_stretched": Entry(
        "warning",
        "This view's pixels are not square: its image was stretched, by `fx_over_fy`, and at"
        " the sides more than in the middle if there is a `bend`. Unless it is undone (`applied`"
        " 1), structures bend.",
        "Turn off the stretching in the camera (SuperView and its like), or find keypoints in"
        " the image before it was stretched. Or fit with `mend: auto`, which undoes it in the"
        " fit and in lifts of its model (`applied` 1).",
    ),
    "view_mirrored": Entry(
        "warning",
        "This view's image is a mirror image. No camera explains it together with the others"
        " unless it is undone (`applied` 1). With `sides_exchanged` 1 its left and right"
        " keypoints were exchanged, too.",
        "Turn off mirroring in the camera or its software, or have it undone where files are"
        " read (`mirror`). Or fit with `mend: auto`, which undoes it in the fit and in lifts of"
        " its model (`applied` 1).",
    ),
    "view_turned": Entry(
        "info",
        "This view's image is upside down or lies on its side (`degrees`), beside the other"
        " views. Its camera is found all the same; only the middle of its lens may be expected"
        " at a wrong place.",
        "Turn the video before keypoints are found: detectors know people that stand. Or fit"
        " with `mend: auto`, which undoes it in the fit and in lifts of its model (`applied` 1).",
    ),
    "axes_exchanged": Entry(
        "warning",
        "In this view's keypoints x and y are exchanged: rows and columns. No camera explains"
        " it together with the others unless it is undone (`applied` 1).",
        "Write x, to the right, before y, downwards. Or fit with `mend: auto`, which undoes it"
        " in the fit and in lifts of its model (`applied` 1).",
    ),
    "rig_not_used": Entry(
        "warning",
        "The cameras of the fit do not explain these frames, so each view got a camera of its own.",
        "Check that `views` names them in the right order, that the views are in step, and that"
        " no camera was moved since the fit.",
    ),
    "frame_unlike_fit": Entry(
        "warning",
        "These frames are unlike all frames of the fit: their structures are less certain.",
        "Fit a capture that has such poses, or start a fit from this model with them.",
    ),
    "coordinates_of_another_scale": Entry(
        "warning",
        "The coordinates have another scale than those of the fit.",
        "Send pixels of images of the size that the fit had, not shares of the image.",
    ),
    "not_in_room": Entry(
        "warning",
        "These frames have structures, but no place in the room: they have no static perspective"
        " camera, or none that determines their unit. Their points and cameras are empty.",
        "Ask for the canonical frame of reference, or lift with `refine: full` and with views of"
        " two static cameras.",
    ),
}
CODES: tuple[FindingCode, ...] = tuple(
    code for group in get_args(FindingCode) for code in get_args(group.__value__)
)
