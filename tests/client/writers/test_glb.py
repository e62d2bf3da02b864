"""glTF, by pygltflib and the rules of its specification."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fewview import Animation, write
from fewview.errors import FormatError
from fewview.readers.skeletons import SKELETONS
from numpy.typing import NDArray
from pygltflib import GLTF2
from scipy.spatial.transform import Rotation

from tests.node import node
from tests.page.project import checked_out

WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
KINDS = {5126: np.float32, 5123: np.uint16}


def values(file: Any, place: int) -> NDArray[np.float64]:
    """Return the values of an accessor, after checking that it keeps the rules."""
    accessor = file.accessors[place]
    view = file.bufferViews[accessor.bufferView]
    kind, width = KINDS[accessor.componentType], WIDTHS[accessor.type]
    assert view.byteOffset % 4 == 0
    assert view.byteOffset + view.byteLength <= file.buffers[0].byteLength
    data = file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    array = np.frombuffer(data, kind).reshape(accessor.count, width)
    np.testing.assert_allclose(array.min(0), accessor.min)
    np.testing.assert_allclose(array.max(0), accessor.max)
    return array.astype(np.float64)


def motion(file: Any, node: int) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return times (n,) and values (n, width) of each animated part of a node."""
    found = {}
    for channel in file.animations[0].channels:
        if channel.target.node == node:
            sampler = file.animations[0].samplers[channel.sampler]
            assert sampler.interpolation == "LINEAR"
            times = values(file, sampler.input)[:, 0]
            assert times[0] >= 0
            assert (np.diff(times) > 0).all()
            message = values(file, sampler.output)
            assert len(message) == len(times)
            found[channel.target.path] = (times, message)
    return found


# Prints the report of Khronos's validator for each file.
VALIDATE = """
import { readFileSync } from "node:fs";
import validator from "gltf-validator";
for (const file of process.argv.slice(1)) {
  const report = await validator.validateBytes(new Uint8Array(readFileSync(file)));
  console.log(JSON.stringify(report.issues));
}
"""


@pytest.fixture
def file(tmp_path: Path, animation: Animation) -> Any:
    return GLTF2().load(str(write(tmp_path / "a.glb", animation)))


def test_keypoints_are_nodes_with_keyframes_where_they_are_seen(
    file: Any, animation: Animation
) -> None:
    assert file.asset.version == "2.0"
    assert [node.name for node in file.nodes[:5]] == list(animation.names)
    assert file.scenes[0].nodes == list(range(len(file.nodes)))
    for place in range(4):
        there = animation.seen[:, place]
        times, places = motion(file, place)["translation"]
        np.testing.assert_allclose(times, animation.seconds[there], rtol=1e-6)
        np.testing.assert_allclose(places, animation.points[there, place], rtol=1e-6)
    assert not motion(file, 4)
    assert file.nodes[4].mesh is None


def test_sticks_reach_from_one_keypoint_to_the_other(file: Any, animation: Animation) -> None:
    sticks = {node.name: place for place, node in enumerate(file.nodes) if node.mesh == 1}
    assert list(sticks) == ["nose to left hip", "left hip to knee é", "foot to knee é"]
    for name, (first, second) in zip(sticks, animation.edges, strict=False):
        parts = motion(file, sticks[name])
        there = animation.seen[:, first] & animation.seen[:, second]
        turns = parts["rotation"][1]
        np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1, atol=1e-6)
        assert (np.sum(turns[1:] * turns[:-1], axis=1) >= 0).all()
        for end, keypoint in ((-0.5, first), (0.5, second)):
            tip = Rotation.from_quat(turns).apply(parts["scale"][1] * [0, end, 0])
            np.testing.assert_allclose(
                tip + parts["translation"][1], animation.points[there, keypoint], atol=1e-5
            )


def test_meshes_face_outward(file: Any) -> None:
    for mesh in file.meshes:
        corners = values(file, mesh.primitives[0].attributes.POSITION)
        faces = corners[values(file, mesh.primitives[0].indices).astype(int).reshape(-1, 3)]
        normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
        assert (np.sum(normals * faces.mean(1), axis=1) > 0).all()
        assert file.materials[mesh.primitives[0].material].doubleSided


def test_bytes_are_laid_out_as_specified(tmp_path: Path, animation: Animation) -> None:
    data = write(tmp_path / "a.glb", animation).read_bytes()
    magic, version, length, size = np.frombuffer(data[:16], "<u4").tolist()
    assert (magic, version, length) == (0x46546C67, 2, len(data))
    assert (data[16:20], size % 4, data[20 + size + 4 : 20 + size + 8]) == (b"JSON", 0, b"BIN\0")


@pytest.mark.thorough
def test_the_validator_of_khronos_finds_nothing(
    tmp_path: Path, animation: Animation, tmp_path_factory: pytest.TempPathFactory
) -> None:
    page = checked_out(tmp_path_factory)
    rng = np.random.default_rng(0)
    made = {"walk": animation, "lone": Animation(animation.points[:1])}
    for name, skeleton in SKELETONS.items():
        points = rng.normal(size=(9, len(skeleton.names), 3))
        points[rng.random(points.shape[:2]) < 0.2] = np.nan
        points[4] = np.nan  # nobody is seen
        made[name] = Animation(points, unit="mm", fps=50, edges=skeleton.edges)
    files = [str(write(tmp_path / f"{name}.glb", each)) for name, each in made.items()]
    reports = node(page, "--input-type=module", "--eval", VALIDATE, *files).splitlines()
    for name, report in zip(made, reports, strict=True):
        found = json.loads(report)["messages"]
        # A keypoint that is never seen is a node with nothing but its name.
        assert [issue for issue in found if issue["code"] != "NODE_EMPTY"] == [], name


def test_straight_down_and_lone_points_and_millimetres(tmp_path: Path) -> None:
    points = np.zeros((3, 2, 3))
    points[:, 1, 1] = [-1000, -2000, 500]  # against the stick's own axis, then along it
    upright = Animation(points, unit="mm", edges=((0, 1),))
    file = GLTF2().load(str(write(tmp_path / "a.glb", upright)))
    np.testing.assert_allclose(motion(file, 1)["translation"][1][:, 1], [-1, -2, 0.5])
    ends = Rotation.from_quat(motion(file, 2)["rotation"][1]).apply([0, 1, 0])
    np.testing.assert_allclose(ends[:, 1], [-1, -1, 1], atol=1e-6)
    lone: Any = GLTF2().load(str(write(tmp_path / "b.glb", Animation(points[:1]))))
    assert len(lone.meshes) == len(lone.materials) == 1


def test_what_gltf_cannot_say_is_refused(tmp_path: Path, animation: Animation) -> None:
    with pytest.raises(FormatError, match="float32"):
        write(tmp_path / "a.glb", replace(animation, times=np.r_[0, 1e6 + 1e-3 * np.arange(11)]))
    with pytest.raises(FormatError, match="ever seen"):
        write(tmp_path / "a.glb", Animation(np.full((2, 1, 3), np.nan)))
    assert not list(tmp_path.iterdir())
