"""Poses as VMC and OSC have them: bones, and what is missing."""

from typing import Any

import numpy as np
import pytest
from fewview.live.bodies import Body
from fewview.live.holding import Holder
from fewview.live.osc import bundles, message
from fewview.live.targets import writer_for

from tests.client.osc import read_osc


def test_bones_are_sent_as_unity_names_them() -> None:
    holder = Holder(len(REST), hold=1, fade=1)
    pose = holder.take(0, np.array(list(REST.values()), float), None, 0)
    (data,) = writer_for("vmc", list(REST), 1.0)(pose)
    found = read_osc(data)
    assert found[0] == ("/VMC/Ext/OK", [1])
    assert [address for address, _ in found[1:3]] == ["/VMC/Ext/T", "/VMC/Ext/Root/Pos"]
    assert all(address == "/VMC/Ext/Bone/Pos" for address, _ in found[3:])
    names = [params[0] for _, params in found[3:]]
    assert names == ["Hips", "Spine", "LeftUpperArm", "LeftLowerArm"]


def turned(points: dict[str, tuple[float, float, float]], **fewer: float) -> dict[str, Any]:
    holder = Holder(len(points), hold=1, fade=1)
    holder.take(0, np.array(list(points.values()), float), None, 0)
    pose = holder.pose(fewer.get("after", 0))
    return {bone.name: bone for bone in Body(list(points)).turned(pose, metres=2)}


REST = {
    "left_shoulder": (-0.2, 1.4, 0),
    "right_shoulder": (0.2, 1.4, 0),
    "left_hip": (-0.1, 0.9, 0),
    "right_hip": (0.1, 0.9, 0),
    "left_elbow": (-0.5, 1.4, 0),
    "left_wrist": (-0.8, 1.4, 0),
}


def test_a_body_at_rest_is_not_turned_and_a_raised_arm_is() -> None:
    """The T looks along Unity's +z; a left arm that points ahead is turned by +90 degrees."""
    rest = turned({**REST, "left_hip": (-0.1, 0.9, 0.5), "right_hip": (0.1, 0.9, 0.5)} | REST)
    assert rest.keys() == {"Hips", "Spine", "LeftUpperArm", "LeftLowerArm"}
    assert rest["Hips"].position == pytest.approx((0, 1.8, 0))
    for bone in rest.values():
        assert bone.rotation == pytest.approx((0, 0, 0, 1), abs=1e-5)
    half = np.sqrt(0.5)
    ahead = {**REST, "left_elbow": (-0.2, 1.4, -0.3), "left_wrist": (-0.2, 1.4, -0.6)}
    arm = turned(ahead)["LeftUpperArm"].rotation
    # In Unity's axes the quaternion must take (-1, 0, 0) to (0, 0, 1).
    assert rotated(arm, (-1, 0, 0)) == pytest.approx((0, 0, 1), abs=1e-5)
    assert abs(arm[1]) == pytest.approx(half, abs=1e-5)
    assert turned(ahead)["LeftLowerArm"].rotation == pytest.approx((0, 0, 0, 1), abs=1e-5)
    about = {name: (-x, y, -z) for name, (x, y, z) in ahead.items()}  # looks the other way
    assert turned(about)["LeftUpperArm"].rotation == pytest.approx(arm, abs=1e-5)
    assert rotated(turned(about)["Hips"].rotation, (0, 0, 1)) == pytest.approx((0, 0, -1), abs=1e-5)


def test_what_is_missing_is_held_then_turns_back_to_rest_then_is_gone() -> None:
    ahead = {**REST, "left_elbow": (-0.2, 1.4, -0.3), "left_wrist": (-0.2, 1.4, -0.6)}
    angles = [
        np.degrees(2 * np.arccos(turned(ahead, after=after)["LeftUpperArm"].rotation[3]))
        for after in (0.9, 1.5)
    ]
    assert angles == pytest.approx([90, 45], abs=0.001)
    assert turned(ahead, after=2) == {}


def rotated(quaternion: tuple[float, ...], vector: tuple[float, ...]) -> Any:
    """Turn a vector by a quaternion x, y, z, w as Unity does: v + 2 q x (q x v + w v)."""
    axis, w = np.array(quaternion[:3]), quaternion[3]
    return np.array(vector) + 2 * np.cross(axis, np.cross(axis, vector) + w * np.array(vector))


def test_messages_are_read_by_the_library_of_others() -> None:
    sent: list[tuple[str, list[str | int | float]]] = [
        (f"/fewview/{'x' * length}", ["é" * length, length, 0.5]) for length in range(60)
    ]
    found = []
    for data in bundles(message(address, *values) for address, values in sent):
        assert len(data) <= 1400
        found += read_osc(data)
    assert found == sent
