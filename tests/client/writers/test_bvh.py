"""BVH, by a parser and forward kinematics that know nothing of the writer."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from fewview import Animation, write
from fewview.errors import FormatError
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


@dataclass
class Joint:
    name: str
    parent: "Joint | None"
    offset: list[float] = field(default_factory=list)
    channels: list[str] = field(default_factory=list)


def read_bvh(path: Path) -> tuple[list[Joint], Float64, float]:
    """Return joints in the order of their channels, the motion (N, channels), seconds a frame."""
    words = iter(path.read_text(encoding="utf-8").split())
    joints: list[Joint] = []
    stack: list[Joint | None] = []
    current: Joint | None = None
    assert next(words) == "HIERARCHY"
    for word in words:
        if word in {"ROOT", "JOINT"}:
            current = Joint(next(words), stack[-1] if stack else None)
            joints.append(current)
        elif word == "End":
            assert next(words) == "Site"
            current = Joint("", stack[-1])
        elif word == "{":
            stack.append(current)
        elif word == "}":
            stack.pop()
        elif word == "OFFSET":
            assert current is not None
            current.offset = [float(next(words)) for _ in range(3)]
        elif word == "CHANNELS":
            assert current is not None
            current.channels = [next(words) for _ in range(int(next(words)))]
        elif word == "MOTION":
            break
    assert not stack
    assert next(words) == "Frames:"
    frames = int(next(words))
    assert [next(words), next(words)] == ["Frame", "Time:"]
    step = float(next(words))
    motion = np.array([float(word) for word in words]).reshape(frames, -1)
    return joints, motion, step


def forward(joints: list[Joint], motion: Float64) -> dict[str, Float64]:
    """Return where every joint is in every frame: channels of position replace the offset."""
    places: dict[str, Float64] = {}
    at = 0
    for joint in joints:
        assert joint.channels == ["Xposition", "Yposition", "Zposition"]
        local = motion[:, at : at + 3]
        at += 3
        places[joint.name] = local + (places[joint.parent.name] if joint.parent else 0)
    assert at == motion.shape[1]
    return places


def test_forward_kinematics_gives_the_points_back(tmp_path: Path, animation: Animation) -> None:
    joints, motion, step = read_bvh(write(tmp_path / "a.bvh", animation))
    assert step == pytest.approx(1 / 25)
    assert joints[0].name == "nose" or joints[0].parent is None
    assert [joint.name for joint in joints if joint.parent is None] == ["left_hip"]
    places = forward(joints, motion)
    for point, name in enumerate(("nose", "left_hip", "knee_é", "foot")):
        there = animation.seen[:, point]
        np.testing.assert_allclose(
            places[name][there], animation.points[there, point], rtol=1e-6, atol=1e-7
        )
    before, after = animation.points[2, 2], animation.points[5, 2]  # a gap is bridged
    np.testing.assert_allclose(places["knee_é"][3], before + (after - before) / 3, atol=1e-6)
    np.testing.assert_allclose(places["knee_é"][0], animation.points[1, 2], atol=1e-6)
    np.testing.assert_allclose(places["tail"], places["left_hip"])
    knee = next(joint for joint in joints if joint.name == "foot")
    assert knee.offset == pytest.approx(
        np.median(places["foot"] - places["knee_é"], axis=0), abs=1e-6
    )


def test_a_tree_without_a_hip_hangs_on_its_middle(tmp_path: Path) -> None:
    chain = Animation(
        np.random.default_rng(0).normal(size=(3, 5, 3)), edges=((4, 3), (3, 0), (0, 1), (2, 1))
    )
    joints, motion, _ = read_bvh(write(tmp_path / "a.bvh", chain))
    assert joints[0].name == "point1"
    places = forward(joints, motion)
    for point, name in enumerate(chain.names):
        np.testing.assert_allclose(places[name], chain.points[:, point], atol=1e-6)


def test_a_root_that_was_never_seen_is_among_the_others(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(3, 3, 3))
    points[:, 0] = np.nan
    hidden = Animation(points, keypoint_names=("hip", "a", "b"), edges=((0, 1), (0, 2)))
    joints, motion, _ = read_bvh(write(tmp_path / "a.bvh", hidden))
    places = forward(joints, motion)
    np.testing.assert_allclose(places["hip"], points[:, 1:].mean(1), atol=1e-6)
    np.testing.assert_allclose(places["b"], points[:, 2], atol=1e-6)


def test_other_skeletons_are_refused(tmp_path: Path, animation: Animation) -> None:
    for change, why in (
        ({"edges": ((0, 1), (1, 2), (2, 3))}, "tail are apart from nose"),
        ({"edges": (*animation.edges, (0, 3))}, "nose and foot close a circle"),
        ({"keypoint_names": ("a b", "a_b", "c", "d", "e")}, "blanks"),
        ({"points": np.full((2, 5, 3), np.nan)}, "ever seen"),
        ({"fps": None, "times": np.arange(12.0) ** 2}, "uneven"),
    ):
        with pytest.raises(FormatError, match=why):
            write(tmp_path / "a.bvh", replace(animation, **change))
    assert not list(tmp_path.iterdir())
