"""BVH, by a parser and forward kinematics that know nothing of the writer."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from fewview import Animation, write
from fewview.errors import FormatError
from fewview.readers.skeletons import SKELETONS
from fewview.writers.body_tree import with_body_tree
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

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
    """Return where every joint is in every frame: R = Rz Rx Ry, by SciPy."""
    places: dict[str, Float64] = {}
    turns: dict[str, Rotation] = {}
    at = 0
    for joint in joints:
        shift = np.array(joint.offset)
        if joint.parent is None:
            assert joint.channels[:3] == ["Xposition", "Yposition", "Zposition"]
            shift, at = motion[:, :3], 3
        assert joint.channels[-3:] == ["Zrotation", "Xrotation", "Yrotation"]
        assert len(joint.channels) == (6 if joint.parent is None else 3)
        own = Rotation.from_euler("ZXY", motion[:, at : at + 3], degrees=True)
        at += 3
        if joint.parent is None:
            places[joint.name], turns[joint.name] = shift, own
        else:
            before = turns[joint.parent.name]
            places[joint.name] = places[joint.parent.name] + before.apply(shift)
            turns[joint.name] = before * own
    assert at == motion.shape[1]
    return places


def figure(frames: int = 30, *, stretch: float = 0.0) -> Animation:
    """Return a figure of rigid bones that turns all its joints; a bone is longer by a share."""
    rng = np.random.default_rng(7)
    names = ("hip", "chest", "neck", "left", "right", "elbow", "hand")
    edges = ((0, 1), (1, 2), (1, 3), (1, 4), (3, 5), (5, 6))
    rest = rng.normal(size=(7, 3))
    points = np.cumsum(rng.normal(size=(frames, 7, 3)) * 0.1, 0)
    turns = {}
    for joint in range(7):
        own = np.cumsum(rng.normal(size=(frames, 3)) * 0.2, 0)
        before = [first for first, second in edges if second == joint]
        turns[joint] = Rotation.from_rotvec(own)
        for parent in before:
            longer = 1 + stretch * np.sin(np.arange(frames))[:, None]
            points[:, joint] = points[:, parent] + turns[parent].apply(rest[joint]) * longer
            turns[joint] = turns[parent] * turns[joint]
    return Animation(points, fps=25, keypoint_names=names, edges=edges)


def test_rigid_bones_give_the_points_back(tmp_path: Path) -> None:
    rigid = figure()
    joints, motion, step = read_bvh(write(tmp_path / "a.bvh", rigid))
    assert step == pytest.approx(1 / 25)
    assert [joint.name for joint in joints if joint.parent is None] == ["hip"]
    places = forward(joints, motion)
    for point, name in enumerate(rigid.names):
        np.testing.assert_allclose(places[name], rigid.points[:, point], atol=2e-5)
    assert np.abs(np.diff(motion[:, 3:], axis=0)).max() < 180  # no jumps of whole turns


def test_bones_that_stretch_have_their_median_length(tmp_path: Path) -> None:
    """A point is off by what the bones of its chain are longer or shorter, and no more."""
    seen = figure(stretch=0.05)
    joints, motion, _ = read_bvh(write(tmp_path / "a.bvh", seen))
    places = forward(joints, motion)
    index = {name: point for point, name in enumerate(seen.names)}
    allowed = {"hip": np.zeros(len(motion))}
    for joint in joints[1:]:
        assert joint.parent is not None
        before, after = (seen.points[:, index[one.name]] for one in (joint.parent, joint))
        lengths = np.linalg.norm(after - before, axis=-1)
        assert np.linalg.norm(joint.offset) == pytest.approx(np.median(lengths), rel=1e-6)
        stretched = np.abs(lengths - np.median(lengths))
        allowed[joint.name] = allowed[joint.parent.name] + stretched
        off = np.linalg.norm(places[joint.name] - after, axis=-1)
        assert (off <= allowed[joint.name] + 1e-4).all(), joint.name
    assert max(allowed["hand"]) > 0.05


def test_a_bone_alone_turns_without_a_twist(tmp_path: Path) -> None:
    """Its rotations are the shortest from the bone at rest, and all of them in one plane here."""
    angle = np.linspace(-1, 1, 9)
    points = np.zeros((9, 2, 3))
    points[:, 1] = np.stack([np.sin(angle), np.cos(angle), 0 * angle], -1)
    bone = Animation(points, fps=10, keypoint_names=("root", "end"), edges=((0, 1),))
    joints, motion, _ = read_bvh(write(tmp_path / "a.bvh", bone))
    assert joints[1].offset == pytest.approx([0, 1, 0], abs=1e-6)
    np.testing.assert_allclose(motion[:, 3], -np.degrees(angle), atol=1e-3)
    np.testing.assert_allclose(motion[:, 4:], 0, atol=1e-3)


def test_gaps_are_bridged(tmp_path: Path, animation: Animation) -> None:
    joints, motion, _ = read_bvh(write(tmp_path / "a.bvh", animation))
    assert [joint.name for joint in joints if joint.parent is None] == ["left_hip"]
    places = forward(joints, motion)
    np.testing.assert_allclose(places["left_hip"], animation.points[:, 1], atol=1e-6)
    np.testing.assert_allclose(places["tail"], places["left_hip"], atol=1e-9)  # never seen
    knee = places["knee_é"] - places["left_hip"]
    before, after = (animation.points[n, 2] for n in (2, 5))
    bridged = before + (after - before) / 3 - animation.points[3, 1]
    cosine = (knee[3] @ bridged) / np.linalg.norm(knee[3]) / np.linalg.norm(bridged)
    assert cosine > 0.7  # as far as one joint can turn three bones that are not rigid


def test_an_edge_that_closes_a_circle_is_left_out(tmp_path: Path, animation: Animation) -> None:
    tree = write(tmp_path / "tree.bvh", animation).read_text()
    circle = replace(animation, edges=(*animation.edges, (0, 3)))
    assert write(tmp_path / "circle.bvh", circle).read_text() == tree


def test_a_tree_without_a_hip_hangs_on_its_middle(tmp_path: Path) -> None:
    chain = Animation(
        np.random.default_rng(0).normal(size=(3, 5, 3)), edges=((4, 3), (3, 0), (0, 1), (2, 1))
    )
    joints, motion, _ = read_bvh(write(tmp_path / "a.bvh", chain))
    assert joints[0].name == "point1"
    np.testing.assert_allclose(forward(joints, motion)["point1"], chain.points[:, 0], atol=1e-6)


def test_a_root_that_was_never_seen_is_among_the_others(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(3, 3, 3))
    points[:, 0] = np.nan
    hidden = Animation(points, keypoint_names=("hip", "a", "b"), edges=((0, 1), (0, 2)))
    joints, motion, _ = read_bvh(write(tmp_path / "a.bvh", hidden))
    places = forward(joints, motion)
    np.testing.assert_allclose(places["hip"], points[:, 1:].mean(1), atol=1e-6)


def body(name: str, frames: int = 20) -> Animation:
    """Return a body of rigid parts, of a skeleton that is known by name; its limbs turn freely."""
    rng = np.random.default_rng(3)
    skeleton = SKELETONS[name]
    shape = Animation(rng.normal(size=(1, len(skeleton.names), 3)), keypoint_names=skeleton.names)
    whole = with_body_tree(replace(shape, edges=skeleton.edges))
    names, parents = whole.names, {second: first for first, second in whole.edges}
    rest = rng.normal(size=(len(names), 3)) * 0.3
    for place, message in enumerate(names):  # a centre is in the middle of its pair
        left = re.sub("^right|^R(?=[A-Z])", lambda m: "left" if m[0] == "right" else "L", message)
        if left != message and message.lower().endswith(("hip", "shoulder")):
            rest[place] = -rest[names.index(left)]
    points = np.zeros((frames, len(names), 3))
    turns: dict[int, Rotation] = {}
    root = next(place for place in range(len(names)) if place not in parents)
    points[:, root] = np.cumsum(rng.normal(size=(frames, 3)) * 0.1, 0)
    order = [root]
    for place in order:
        own = Rotation.from_rotvec(np.cumsum(rng.normal(size=(frames, 3)) * 0.2, 0))
        turns[place] = turns[parents[place]] * own if place in parents else own
        for child in (c for c, p in parents.items() if p == place):
            points[:, child] = points[:, place] + turns[place].apply(rest[child])
            order.append(child)
    count = len(skeleton.names)
    return Animation(points[:, :count], fps=30, keypoint_names=skeleton.names, edges=skeleton.edges)


@pytest.mark.parametrize("name", [name for name in SKELETONS if name != "hands-21"])
def test_bodies_of_all_skeletons_move_as_they_did(tmp_path: Path, name: str) -> None:
    moved = body(name)
    joints, motion, _ = read_bvh(write(tmp_path / "a.bvh", moved))
    places = forward(joints, motion)
    for point, message in enumerate(moved.names):
        np.testing.assert_allclose(places[message], moved.points[:, point], atol=1e-4)
    assert len([joint for joint in joints if joint.parent is None]) == 1


def test_hands_are_written(tmp_path: Path) -> None:
    hand = SKELETONS["hands-21"]
    points = np.random.default_rng(0).normal(size=(3, 21, 3))
    moved = Animation(points, keypoint_names=hand.names, edges=hand.edges)
    assert len(read_bvh(write(tmp_path / "a.bvh", moved))[0]) == 21


def test_other_skeletons_are_refused(tmp_path: Path, animation: Animation) -> None:
    for change, why in (
        ({"edges": ((0, 1), (1, 2), (2, 3))}, "tail are apart from nose"),
        ({"keypoint_names": ("a b", "a_b", "c", "d", "e")}, "blanks"),
        ({"points": np.full((2, 5, 3), np.nan)}, "ever seen"),
        ({"fps": None, "times": np.arange(12.0) ** 2}, "uneven"),
    ):
        with pytest.raises(FormatError, match=why):
            write(tmp_path / "a.bvh", replace(animation, **change))
    assert not list(tmp_path.iterdir())
