"""Skeletons that are known by name: the names of keypoints and what joins them."""

from collections.abc import Sequence

from fewview.errors import FormatError
from fewview.readers.chains import Skeleton, both, sides, skeleton
from fewview.readers.other_skeletons import OTHERS
from fewview.readers.views import Edges

_COCO = (
    "nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder left_elbow "
    "right_elbow left_wrist right_wrist left_hip right_hip left_knee right_knee left_ankle "
    "right_ankle"
)
_COCO_EDGES = sides(
    "nose-*_eye-*_ear *_shoulder-*_elbow-*_wrist *_shoulder-*_hip-*_knee-*_ankle"
) + (" left_shoulder-right_shoulder left_hip-right_hip")
_HAND = "wrist " + " ".join(
    f"{finger}{joint}"
    for finger in ("thumb", "index", "middle", "ring", "pinky")
    for joint in (1, 2, 3, 4)
)
_HAND_EDGES = " ".join(
    "wrist-" + "-".join(f"{finger}{joint}" for joint in (1, 2, 3, 4))
    for finger in ("thumb", "index", "middle", "ring", "pinky")
)
_FEET = "left_big_toe left_small_toe left_heel right_big_toe right_small_toe right_heel"
_FEET_EDGES = sides("*_ankle-*_heel *_ankle-*_big_toe-*_small_toe")
_BODY_25 = (
    "Nose Neck RShoulder RElbow RWrist LShoulder LElbow LWrist MidHip RHip RKnee RAnkle LHip LKnee "
    "LAnkle REye LEye REar LEar LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel"
)
_BODY_25B = (
    "Nose LEye REye LEar REar LShoulder RShoulder LElbow RElbow LWrist RWrist LHip RHip LKnee "
    "RKnee LAnkle RAnkle Neck Head LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel"
)
_H36M = (
    "pelvis right_hip right_knee right_ankle left_hip left_knee left_ankle spine thorax neck head "
    "left_shoulder left_elbow left_wrist right_shoulder right_elbow right_wrist"
)
_MEDIAPIPE = (
    "nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer "
    "left_ear right_ear mouth_left mouth_right left_shoulder right_shoulder left_elbow "
    "right_elbow left_wrist right_wrist left_pinky right_pinky left_index right_index left_thumb "
    "right_thumb left_hip right_hip left_knee right_knee left_ankle right_ankle left_heel "
    "right_heel left_foot_index right_foot_index"
)


def _whole_body() -> tuple[str, str]:
    """Return the names and chains of COCO-WholeBody: body, feet, 68 of the face, two hands."""
    face = [f"face_{index}" for index in range(68)]
    hands = [f"{side}_hand_{name}" for side in ("left", "right") for name in _HAND.split()]
    arcs = ((0, 17), (17, 22), (22, 27), (27, 31), (31, 36), (36, 42), (42, 48), (48, 60), (60, 68))
    chains = ["-".join(face[start:end]) for start, end in arcs]
    for side in ("left", "right"):
        chains.append(f"{side}_wrist-{side}_hand_wrist")
        chains += [
            "-".join(f"{side}_hand_{name}" for name in chain.split("-"))
            for chain in _HAND_EDGES.split()
        ]
    return (
        " ".join([_COCO, _FEET, *face, *hands]),
        " ".join([_COCO_EDGES, _FEET_EDGES, *chains]),
    )


SKELETONS = {
    "coco-17": skeleton("COCO-17", _COCO, _COCO_EDGES),
    "body-25": skeleton(
        "BODY_25",
        _BODY_25,
        both(
            "Nose-*Eye-*Ear Neck-*Shoulder-*Elbow-*Wrist MidHip-*Hip-*Knee-*Ankle "
            "*Ankle-*BigToe-*SmallToe *Ankle-*Heel"
        )
        + " Nose-Neck-MidHip",
    ),
    "body-25b": skeleton(
        "BODY_25B",
        _BODY_25B,
        both(
            "Nose-*Eye-*Ear Neck-*Shoulder-*Elbow-*Wrist *Shoulder-*Hip-*Knee-*Ankle "
            "*Ankle-*BigToe-*SmallToe *Ankle-*Heel"
        )
        + " Nose-Neck-Head LHip-RHip",
    ),
    "coco-133": skeleton("COCO-133", *_whole_body()),
    "h36m-17": skeleton(
        "H36M-17",
        _H36M,
        sides("pelvis-*_hip-*_knee-*_ankle thorax-*_shoulder-*_elbow-*_wrist")
        + " pelvis-spine-thorax-neck-head",
    ),
    "halpe-26": skeleton(
        "Halpe-26",
        f"{_COCO} head neck hip left_big_toe right_big_toe left_small_toe right_small_toe "
        "left_heel right_heel",
        sides(
            "nose-*_eye-*_ear neck-*_shoulder-*_elbow-*_wrist hip-*_hip-*_knee-*_ankle "
            "*_ankle-*_heel *_ankle-*_big_toe-*_small_toe"
        )
        + " head-neck-hip",
    ),
    "mediapipe-33": skeleton(
        "MediaPipe-33",
        _MEDIAPIPE,
        sides(
            "nose-*_eye_inner-*_eye-*_eye_outer-*_ear *_shoulder-*_elbow-*_wrist-*_pinky-*_index "
            "*_wrist-*_index *_wrist-*_thumb *_shoulder-*_hip-*_knee-*_ankle-*_heel-*_foot_index "
            "*_ankle-*_foot_index"
        )
        + " mouth_left-mouth_right left_shoulder-right_shoulder left_hip-right_hip",
    ),
    "hands-21": skeleton("hands-21", _HAND, _HAND_EDGES),
}


# Whose numbers of keypoints mean them where nothing has names, and those that names alone mean.
NAMED = SKELETONS | OTHERS


def _plain(name: str) -> str:
    return "".join(filter(str.isalnum, name.lower()))


def skeleton_of(
    count: int, name: str | None, meant: tuple[str, ...] = ()
) -> tuple[Skeleton | None, tuple[str, ...]]:
    """Return the skeleton of this many keypoints, and the names that might be meant.

    Parameters
    ----------
    name
        As it was asked for, in any spelling, such as ``BODY_25B``; None to go by the count.
    meant
        Names that a format means by their counts.

    Raises
    ------
    FormatError
        If there is no skeleton of this name, or it has another count.
    """
    if name is not None:
        found = next((one for each, one in NAMED.items() if _plain(each) == _plain(name)), None)
        if found is None:
            raise FormatError(
                f"there is no skeleton {name!r}; there are {', '.join(NAMED)}",
                option="skeleton",
            )
        if len(found.names) != count:
            raise FormatError(
                f"{found.title} has {len(found.names)} keypoints, not {count}", option="skeleton"
            )
        return found, ()
    fitting = tuple(each for each, known in SKELETONS.items() if len(known.names) == count)
    by_format = tuple(each for each in fitting if each in meant)
    if len(by_format) == 1 or len(fitting) == 1:
        return SKELETONS[(by_format or fitting)[0]], ()
    return None, fitting


def edges_of(names: Sequence[str]) -> Edges | None:
    """Return the edges of the skeleton whose keypoints have these names, in any order and spelling.

    None if there is none.
    """
    place = {_plain(name): index for index, name in enumerate(names)}
    for known in NAMED.values():
        own = [_plain(name) for name in known.names]
        if len(names) == len(own) and place.keys() == set(own):
            return tuple((place[own[a]], place[own[b]]) for a, b in known.edges)
    return None
