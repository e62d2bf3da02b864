"""Animated glTF 2.0 in one binary file (.glb): a ball for every keypoint, a stick for every edge.

Every keypoint is a node with an animated translation; every edge a node whose translation, rotation
and scale lay a rod from one keypoint to the other. A frame in which a point is missing has no
keyframe of it: viewers go on in a straight line. glTF counts in metres and has y up; points in
millimetres are converted, points without a unit are taken as they are.

Source: Khronos Group, "glTF 2.0 Specification", 2.0.1.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fewview.animation import Animation
from fewview.errors import FormatError

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

FLOAT, SHORT = 5126, 5123  # component types
VERTICES, INDICES = 34962, 34963  # targets of buffer views
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
BALL, STICK = 0.012, 0.006  # radii, of the subject's size
SIDES = 8  # of the rod
COLOURS = ((0.90, 0.45, 0.13, 1.0), (0.75, 0.78, 0.82, 1.0))


class _File:
    """A glTF document in the making: its JSON, and the bytes of its buffer."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.nodes: list[dict[str, Any]] = []
        self.samplers: list[dict[str, Any]] = []
        self.channels: list[dict[str, Any]] = []
        self._clocks: dict[bytes, int] = {}

    def add(self, values: NDArray[Any], target: int | None = None) -> int:
        """Add an array (n,) or (n, width) as an accessor, and return its place."""
        array = np.ascontiguousarray(values, np.uint16 if target == INDICES else np.float32)
        view: dict[str, Any] = {
            "buffer": 0,
            "byteOffset": len(self.data),
            "byteLength": array.nbytes,
        }
        self.views.append(view | ({"target": target} if target else {}))
        self.data += array.tobytes() + bytes(-array.nbytes % 4)
        rows = array.reshape(len(array), -1)
        self.accessors.append(
            {
                "bufferView": len(self.views) - 1,
                "componentType": SHORT if target == INDICES else FLOAT,
                "count": len(rows),
                "type": TYPES[rows.shape[1]],
                "min": rows.min(0).tolist(),
                "max": rows.max(0).tolist(),
            }
        )
        return len(self.accessors) - 1

    def animate(self, node: int, seconds: Float64, paths: dict[str, Float64]) -> None:
        """Animate parts of a node's place: 'translation', 'rotation', 'scale' at times (n,)."""
        key = seconds.astype(np.float32).tobytes()
        if key not in self._clocks:
            self._clocks[key] = self.add(seconds)
        for path, values in paths.items():
            sampler = {"input": self._clocks[key], "output": self.add(values)}
            self.samplers.append(sampler | {"interpolation": "LINEAR"})
            target = {"node": node, "path": path}
            self.channels.append({"sampler": len(self.samplers) - 1, "target": target})


def write(path: Path, animation: Animation) -> None:
    """Write an animation as one scene with one animation.

    Raises
    ------
    FormatError
        If no point was ever seen, or two times are one in float32.
    """
    if not animation.seen.any():
        raise FormatError("no point of the animation was ever seen")
    seconds = animation.seconds - animation.seconds[0]
    if (np.diff(seconds.astype(np.float32)) <= 0).any():
        raise FormatError("glTF has times as float32, in which some of these are the same")
    points = animation.points * (0.001 if animation.unit == "mm" else 1.0)
    size = _size(points)
    file = _File()
    for place, name in enumerate(animation.names):
        there = animation.seen[:, place]
        file.nodes.append({"name": name, **({"mesh": 0} if there.any() else {})})
        if there.any():
            file.nodes[-1]["translation"] = points[there, place][0].tolist()
            file.animate(place, seconds[there], {"translation": points[there, place]})
    for first, second in animation.edges:
        there = animation.seen[:, first] & animation.seen[:, second]
        if there.any():
            laid = _rods(points[there, first], points[there, second])
            name = f"{animation.names[first]} to {animation.names[second]}"
            file.nodes.append({"name": name, "mesh": 1})
            file.nodes[-1].update({part: values[0].tolist() for part, values in laid.items()})
            file.animate(len(file.nodes) - 1, seconds[there], laid)
    meshes = [_ball(file, BALL * size)]
    if any(node.get("mesh") == 1 for node in file.nodes):
        meshes.append(_rod(file, STICK * size))
    path.write_bytes(_packed(file, meshes))


def _size(points: Float64) -> float:
    """Return the median extent of the subject, 1 where it has none."""
    seen = points[np.isfinite(points).any((1, 2))]
    extent = float(np.median((np.nanmax(seen, axis=1) - np.nanmin(seen, axis=1)).max(-1)))
    return extent or 1.0


def _rods(begin: Float64, end: Float64) -> dict[str, Float64]:
    """Return translation (n, 3), quaternion xyzw (n, 4) and scale (n, 3) of a unit rod along y.

    Quaternions keep to one half of the sphere from frame to frame, so none turns the long way.
    """
    along = end - begin
    length = np.linalg.norm(along, axis=-1)
    x, y, z = (along / np.where(length > 0, length, 1)[:, None]).T
    turn = np.stack((z, np.zeros_like(x), -x, 1 + y), -1)  # from (0, 1, 0), half of the way
    turn[np.linalg.norm(turn, axis=-1) < 1e-6] = (1.0, 0.0, 0.0, 0.0)
    turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
    flips = np.sum(turn[1:] * turn[:-1], -1) < 0
    turn[1:] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
    ones = np.ones_like(length)
    return {
        "translation": (begin + end) / 2,
        "rotation": turn,
        "scale": np.stack((ones, np.maximum(length, 1e-9), ones), -1),
    }


def _ball(file: _File, radius: float) -> dict[str, Any]:
    """Return the mesh of an octahedron."""
    corners = radius * np.concatenate((np.eye(3), -np.eye(3)))
    faces = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
    return _mesh(file, "keypoint", corners, np.array(faces), 0)


def _rod(file: _File, radius: float) -> dict[str, Any]:
    """Return the mesh of a prism along y from -1/2 to 1/2."""
    angles = 2 * np.pi * np.arange(SIDES) / SIDES
    ring = radius * np.stack((np.cos(angles), np.zeros(SIDES), np.sin(angles)), -1)
    half = np.array([0, 0.5, 0])
    corners = np.concatenate((ring - half, ring + half))
    here = np.arange(SIDES)
    after = (here + 1) % SIDES
    faces = np.concatenate(
        (
            np.stack((here, here + SIDES, after), -1),
            np.stack((after, here + SIDES, after + SIDES), -1),
        )
    )
    return _mesh(file, "stick", corners, faces, 1)


def _mesh(
    file: _File, name: str, corners: Float64, faces: NDArray[np.int64], material: int
) -> dict[str, Any]:
    primitive = {
        "attributes": {"POSITION": file.add(corners, VERTICES)},
        "indices": file.add(faces.ravel(), INDICES),
        "material": material,
    }
    return {"name": name, "primitives": [primitive]}


def _packed(file: _File, meshes: list[dict[str, Any]]) -> bytes:
    """Return the document as GLB: a header, the JSON and the buffer, each a multiple of 4 bytes."""
    materials = [
        {
            "doubleSided": True,
            "pbrMetallicRoughness": {
                "baseColorFactor": colour,
                "metallicFactor": 0.0,
                "roughnessFactor": 0.8,
            },
        }
        for colour in COLOURS[: len(meshes)]
    ]
    document = {
        "asset": {"version": "2.0", "generator": "fewview"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(file.nodes)))}],
        "nodes": file.nodes,
        "meshes": meshes,
        "materials": materials,
        "animations": [{"name": "motion", "samplers": file.samplers, "channels": file.channels}],
        "accessors": file.accessors,
        "bufferViews": file.views,
        "buffers": [{"byteLength": len(file.data)}],
    }
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    whole = 12 + 8 + len(text) + 8 + len(file.data)
    return b"".join(
        (
            struct.pack("<4sII", b"glTF", 2, whole),
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", len(file.data), b"BIN\0"),
            file.data,
        )
    )
