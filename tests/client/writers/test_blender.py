"""What Blender makes of glTF and BVH, where its package `bpy` is installed."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fewview import Animation, write
from fewview.readers.skeletons import SKELETONS
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

bpy: Any = pytest.importorskip("bpy", reason="Blender is not installed")

FRAMES = 12
NEAR = 1e-4  # metres


def figure(name: str) -> Animation:
    """Return a rigid figure that walks and turns, with the keypoints of a skeleton."""
    skeleton = SKELETONS[name]
    still = np.random.default_rng(0).normal(size=(len(skeleton.names), 3))
    turns = Rotation.from_euler("y", 10 * np.arange(FRAMES)[:, None], degrees=True)
    walked = 0.1 * np.arange(FRAMES)[:, None, None] * [1, 0, 0]
    points = np.stack([turn.apply(still) for turn in turns]) + walked
    return Animation(points, unit="m", fps=50, keypoint_names=skeleton.names, edges=skeleton.edges)


def y_up(place: Any) -> NDArray[np.float64]:
    """Return a place of Blender's, whose z is up, in our axes."""
    return np.array([place.x, place.z, -place.y])


@pytest.fixture(autouse=True)
def empty() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = 50


@pytest.mark.parametrize("name", SKELETONS)
def test_keypoints_of_gltf_are_where_they_were(name: str, tmp_path: Path) -> None:
    animation = figure(name)
    bpy.ops.import_scene.gltf(filepath=str(write(tmp_path / "a.glb", animation)))
    for frame in range(FRAMES):
        bpy.context.scene.frame_set(frame)
        found = [y_up(bpy.data.objects[each].matrix_world.translation) for each in animation.names]
        np.testing.assert_allclose(found, animation.points[frame], atol=NEAR)


# Blender's importer leaves the file open.
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("name", SKELETONS)
def test_joints_of_bvh_are_where_they_were(name: str, tmp_path: Path) -> None:
    animation = figure(name)
    file = write(tmp_path / "a.bvh", animation)
    bpy.ops.import_anim.bvh(filepath=str(file), axis_forward="-Z", axis_up="Y")
    (armature,) = (each for each in bpy.data.objects if each.type == "ARMATURE")
    for frame in range(FRAMES):
        bpy.context.scene.frame_set(frame + 1)
        bones = [armature.pose.bones[each] for each in animation.names]
        found = [y_up(armature.matrix_world @ bone.head) for bone in bones]
        np.testing.assert_allclose(found, animation.points[frame], atol=NEAR)
