"""Apple Vision: what it calls the joints of bodies and hands, and that its y goes up.

Points are shares of the image from its lower left corner. Apps write joints under Vision's own
identifiers (`left_upLeg_joint`) or as Swift spells them (`leftHip`), and some turn y downwards.

Source: Apple's documentation of `VNHumanBodyPoseObservation.JointName` and
`VNHumanHandPoseObservation.JointName`.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from fewview.readers.views import View, unseen

BODY = {
    "nose": "head_joint",
    "leftEye": "left_eye_joint",
    "rightEye": "right_eye_joint",
    "leftEar": "left_ear_joint",
    "rightEar": "right_ear_joint",
    "neck": "neck_1_joint",
    "leftShoulder": "left_shoulder_1_joint",
    "rightShoulder": "right_shoulder_1_joint",
    "leftElbow": "left_forearm_joint",
    "rightElbow": "right_forearm_joint",
    "leftWrist": "left_hand_joint",
    "rightWrist": "right_hand_joint",
    "root": "root",
    "leftHip": "left_upLeg_joint",
    "rightHip": "right_upLeg_joint",
    "leftKnee": "left_leg_joint",
    "rightKnee": "right_leg_joint",
    "leftAnkle": "left_foot_joint",
    "rightAnkle": "right_foot_joint",
}
_USUAL = {own: name for name, own in BODY.items()}
_HAND = "VNHLK"  # begins the identifiers of a hand's joints
ABOVE, BELOW = ("nose", "neck", "leftEye", "rightEye"), ("root", "leftHip", "rightHip")
ITS_OWN = {"neck", "root"}  # joints that others who spell names so do not have together
WITHIN = 1.5  # images: shares lie within, pixels do not


def is_vision(names: Iterable[str]) -> bool:
    """Whether joints of these names are Apple Vision's: all are, and some are no others'."""
    given = set(names)
    if given and all(name.startswith(_HAND) for name in given):
        return True
    if not {usual(name) for name in given} <= BODY.keys():
        return False
    return bool(given & _USUAL.keys() - {"root"}) or given >= ITS_OWN


def usual(name: str) -> str:
    """Return a joint's name as Swift spells it."""
    return _USUAL.get(name, name)


def turned_down(view: View) -> View:
    """Return a view with y downwards, if its points are shares of the image under Vision's names.

    They are left where heads are above hips as they stand: an app has turned them.
    """
    if not is_vision(view.keypoint_names or ()):
        return view
    keypoints = np.where(unseen(view.keypoints)[..., None], np.float32(np.nan), view.keypoints)
    if not np.nanmax(np.abs(keypoints), initial=0) <= WITHIN:
        return view
    places = {name: index for index, name in enumerate(map(usual, view.keypoint_names or ()))}
    above, below = (
        [keypoints[..., places[name], 1] for name in group if name in places]
        for group in (ABOVE, BELOW)
    )
    lower = [high - low for high in above for low in below]
    if lower and np.nanmean(np.sign(np.concatenate(lower))) < 0:
        note = "heads are above hips where y goes down: y was left as it is"
    else:
        keypoints[..., 1] = 1 - keypoints[..., 1]
        note = "y was turned downwards, as Apple Vision counts it upwards"
    return replace(view, keypoints=keypoints, notes=(*view.notes, note))
