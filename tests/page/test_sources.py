"""The page's own sources: types, and arithmetic against files and pixels that Python made."""

import json
import re
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from safetensors.numpy import save_file
from scipy.spatial.transform import Rotation

from models.settings.uncertainty import Uncertainty
from service.realtime.stream_frames import Frame, write_answer, write_watched
from service.wire.stream_messages import FRAME, HEADER
from store.capture import Capture
from tests.node import node
from tests.page.project import checked_out
from tests.page.stored import KEYPOINTS, walking

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "examples"))
from projection import project  # noqa: E402

# Of a type as well: two modules whose types need each other are one idea in two places.
IMPORT = re.compile(r'\b(?:from|import\() ?"(\.[^"]+)"')
FRAMES, VIEWS, POINTS = 6, 3, 7
TIMES = np.array([0.0, 1, 2.2, 3, 4, 5]) / 59.94  # seconds: one frame is late
CAMERAS = ("weak_perspective", "perspective", "fisheye")
Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return checked_out(tmp_path_factory)


def test_types_agree_with_the_openapi_document_and_the_linter_finds_nothing(page: Path) -> None:
    node(page, "check.mjs")


def test_components_show_and_do_what_they_should(page: Path) -> None:
    node(page, "--import", "./test/components/tsx.mjs", "--test", "test/components/*.test.tsx")


def test_nothing_is_left_for_the_formatter(page: Path) -> None:
    node(page, "node_modules/prettier/bin/prettier.cjs", "--check", ".")


def test_no_module_of_the_page_leads_back_to_itself() -> None:
    sources = ROOT / "page" / "src"
    modules = {file.resolve(): file.read_text() for file in sources.rglob("*.ts*")}
    imports = {
        file: {(file.parent / found).resolve() for found in IMPORT.findall(text)} & modules.keys()
        for file, text in modules.items()
    }
    assert sum(map(len, imports.values())) > len(modules)  # they were read
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        circle = " -> ".join(str(file.relative_to(sources)) for file in error.args[1])
        pytest.fail(f"modules that import each other, types or not: {circle}")


def test_files_pixels_and_errors_are_those_of_python(page: Path, tmp_path: Path) -> None:
    write_cases(tmp_path)
    write_stream(tmp_path)
    printed = node(page, "--test", "test/*.test.ts", FEWVIEW_CASES=str(tmp_path))
    assert "# fail 0" in printed or "fail 0" in printed
    assert "skipped 0" in printed


def write_cases(folder: Path) -> None:
    """Write a capture, a reconstruction with all kinds of cameras, and what is true of them."""
    rng = np.random.default_rng(4)
    points = rng.normal(size=(FRAMES, POINTS, 3)).astype(np.float32)
    points[2, 3] = np.nan
    cameras = drawn_cameras(rng)
    pixels = np.array(
        [
            [project(points[n].tolist(), wire(cameras, n, k)) for k in range(VIEWS)]
            for n in range(FRAMES)
        ]
    )
    pixels[cameras["camera_models"] == -1] = np.nan
    detected = (pixels + rng.normal(size=pixels.shape) * 3).astype(np.float32)
    detected[rng.random(detected.shape[:3]) < 0.3] = np.nan
    outliers = np.where(rng.random(detected.shape[:3]) < 0.3, 0.9, 0.1).astype(np.float32)
    off = np.linalg.norm(detected - pixels, axis=-1)
    view_errors = np.where(rng.random((FRAMES, VIEWS)) < 0.3, np.nan, 2.5).astype(np.float32)
    view_errors[1] = np.nan
    arrays = {
        **{name: np.ascontiguousarray(array) for name, array in cameras.items()},
        "points3d": points,
        "points3d_sd": np.abs(points[..., 0]) / 10,
        "outlier_probability": outliers,
        "reprojection_errors": view_errors,
    }
    save_file(arrays, folder / "reconstruction.safetensors", {"findings": "[]"})
    write_capture(folder, detected)
    dump(folder / "measures.json", measured(points.astype(np.float64)))
    dump(folder / "pixels.json", listed(pixels))
    truth = {
        "worst": [
            worst(off[n, :, p], outliers[n, :, p]) for n in range(FRAMES) for p in range(POINTS)
        ],
        "means": [None if np.isnan(row).all() else float(np.nanmean(row)) for row in view_errors],
    }
    dump(folder / "errors.json", truth)


def measured(points: Floats) -> dict[str, list[float | None]]:
    """Return lengths, angles and speeds of points (N, P, 3)."""
    found = {}
    for a, b, c in ((0, 1, 2), (3, 5, 6)):
        arms = points[:, a] - points[:, b], points[:, c] - points[:, b]
        sine = np.linalg.norm(np.cross(*arms), axis=1)
        found[f"length {a} {b}"] = np.linalg.norm(arms[0], axis=1)
        found[f"angle {a} {b} {c}"] = np.degrees(np.arctan2(sine, (arms[0] * arms[1]).sum(1)))
        # NumPy has no use for the frame itself where times are even: without it there is no answer.
        gone = np.where(np.isnan(points[:, a, 0]), np.nan, 0.0)
        for name, moments in (("", TIMES), (" of frames", np.arange(FRAMES))):
            velocity = np.gradient(points[:, a], moments, axis=0)
            found[f"speed {a}{name}"] = np.linalg.norm(velocity, axis=1) + gone
    return {name: listed(values) for name, values in found.items()}


def write_stream(folder: Path) -> None:
    """Write an answer of a stream, what it answers to, and what is in both."""
    prior = walking()
    keypoints = KEYPOINTS[3:4].astype(np.float32)
    keypoints[0, 1, 2:5] = np.nan
    lift = prior.lift(keypoints)
    sds = np.linspace(0.1, 0.9, keypoints.shape[2], dtype=np.float32)[None]
    lift = lift._replace(findings=np.array([9], np.uint8), points3d_sd=sds)
    came = Frame(binary=True, sequence=70_000, capture=Capture(keypoints))
    kinds: dict[str, Uncertainty] = {"answer": "sd", "answer-off": "off"}
    for name, uncertainty in kinds.items():
        answer = write_answer(came, lift, prior, uncertainty)
        assert isinstance(answer, bytes)
        (folder / f"{name}.bin").write_bytes(answer)
    (folder / "watched.bin").write_bytes(write_watched(came, lift, "full"))
    frame = HEADER.pack(FRAME, 0, keypoints.shape[1], 3) + keypoints.tobytes()
    (folder / "frame.bin").write_bytes(frame)
    arrays = {name: listed(array[0]) for name, array in lift.arrays.items()}
    dump(folder / "answer.json", arrays | {"sent": listed(keypoints)})


def drawn_cameras(rng: np.random.Generator) -> dict[str, NDArray[Any]]:
    """Return cameras of every model, and none, that have all points before them."""
    shape = (FRAMES, VIEWS)
    models = np.array([[0, 1, 2], [1, 1, 2], [2, 0, 1], [1, 2, 0], [1, -1, 1], [-1, 1, 0]], np.int8)
    turns = Rotation.random(FRAMES * VIEWS, rng=rng).as_matrix().reshape(*shape, 3, 3)
    shifts = rng.normal((0, 0, 12), 1, (*shape, 3))
    weak = models == 0
    shifts[weak] = np.column_stack(
        (rng.normal(size=(weak.sum(), 2)) * 400, np.full(weak.sum(), np.nan))
    )
    distortions = rng.normal(size=(*shape, 8)) * 0.02
    distortions[models == 2, 4:] = 0
    known = {
        "rotations": turns,
        "translations": shifts,
        "scales": np.where(weak, 150.0, np.nan),
        "focals": np.where(weak[..., None], np.nan, 1000 + rng.normal(size=(*shape, 2)) * 50),
        "principal_points": np.where(weak[..., None], np.nan, [640.0, 512.0]),
        "distortions": np.where(weak[..., None], np.nan, distortions),
    }
    absent = models == -1
    for array in known.values():
        array[absent] = np.nan
    return {name: array.astype(np.float32) for name, array in known.items()} | {
        "camera_models": models
    }


def wire(cameras: dict[str, NDArray[Any]], frame: int, view: int) -> dict[str, Any]:
    """Return a camera as JSON has it."""
    at = frame, view
    model = CAMERAS[max(0, int(cameras["camera_models"][at]))]
    translation = cameras["translations"][at].astype(np.float64)
    return {
        "camera": model,
        "rotation": cameras["rotations"][at],
        "translation": translation[:2] if model == CAMERAS[0] else translation,
        "scale": float(cameras["scales"][at]),
        "focal": cameras["focals"][at],
        "principal_point": cameras["principal_points"][at],
        "distortion": cameras["distortions"][at].astype(np.float64),
    }


def worst(off: Floats, outliers: NDArray[Any]) -> float | str:
    """Return the largest error of a keypoint in a frame over the views that were used."""
    if np.isnan(off).all():
        return "unseen"
    used = off[~np.isnan(off) & (outliers <= 0.5)]
    return float(used.max()) if used.size else "left out"


def write_capture(folder: Path, detected: NDArray[np.float32]) -> None:
    names = [f"L_{n}" if n % 2 else "hüfte" + "x" * n for n in range(POINTS)]
    fields: dict[str, Any] = {
        "keypoint_names": names,
        "view_names": ["left", "überkopf", "c"],
        "edges": [[0, 1], [1, 2]],
        "image_sizes": [[1280, 1024], [0, 0], [640, 480]],
        "fps": 59.94,
        "times": TIMES.tolist(),
    }
    arrays: dict[str, Any] = {name: np.array(value) for name, value in fields.items()}
    np.savez(folder / "capture.npz", keypoints=detected, **arrays)
    fields["image_sizes"][1] = None
    fields["fps"] = float(np.float32(fields["fps"]))
    truth = {"shape": detected.shape[:3], "keypoints": listed(detected), **fields}
    dump(folder / "capture.json", truth)


def listed(array: NDArray[Any]) -> list[float | None]:
    return [None if np.isnan(x) else float(x) for x in array.ravel()]


def dump(file: Path, value: Any) -> None:
    file.write_text(json.dumps(value))
