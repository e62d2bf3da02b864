"""What docs/results.md shows does run, and its projections are those of lifts."""

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fewview.api.lifting import Lift
from fewview.calibration import read_cameras
from fewview.commands.reading import OPTIONS
from fewview.readers.registry import NAMES
from safetensors.numpy import load_file

ROOT = Path(__file__).parents[2]
HEADINGS = ("Files out", "How answers project back into the image")


def blocks(heading: str) -> list[str]:
    """Return the Python of a section."""
    text = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    (section,) = re.findall(rf"^## {heading}\n(.*?)(?=^## |\Z)", text, re.DOTALL | re.MULTILINE)
    return re.findall(r"^```python\n(.*?)^```", section, re.DOTALL | re.MULTILINE)


def lift_of(fixture: str, refine: str) -> tuple[Lift, Any]:
    stored = load_file(ROOT / f"tests/fixtures/{fixture}_lifts.safetensors")
    names = [name for name in Lift.__dataclass_fields__ if f"{refine}.{name}" in stored]
    arrays: dict[str, Any] = {name: stored[f"{refine}.{name}"] for name in names}
    return Lift(**arrays), stored["keypoints"]


def test_everything_shown_runs_in_its_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lift, keypoints = lift_of("resting", "auto")
    count = lift.points3d.shape[1]
    shown: dict[str, Any] = {
        "lift": lift,
        "keypoints": keypoints,
        "names": [f"k{place}" for place in range(count)],
        "edges": [(place, place + 1) for place in range(count - 1)],
    }
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Mean of empty slice")  # views that show nothing
        for block in [block for heading in HEADINGS for block in blocks(heading)]:
            exec(block, shown)  # noqa: S102  # it is ours
    written = {file.name for file in tmp_path.iterdir()}
    assert written == {
        "walk.glb",
        "walk.trc",
        "walk.data",
        "walk.gif",
        "rig.toml",
        "rig.yml",
        "sparse",
    }
    for file in ("rig.toml", "rig.yml", "sparse"):
        for one, two in zip(read_cameras(file), shown["cameras"], strict=True):
            np.testing.assert_allclose(
                one.project(shown["room"].points), two.project(shown["room"].points), atol=1e-6
            )
    there = lift.camera_models[:, 0] > 0
    errors = np.linalg.norm(shown["seen_again"] - keypoints[:, 0], axis=-1)[there]
    np.testing.assert_allclose(
        np.nanmean(errors, axis=1), lift.reprojection_errors[there, 0], atol=0.02
    )


def test_every_format_and_option_of_reading_is_described() -> None:
    text = (ROOT / "docs/files.md").read_text(encoding="utf-8")
    (section,) = re.findall(r"^## What is read\n(.*?)^## ", text, re.DOTALL | re.MULTILINE)
    assert set(NAMES) <= set(re.findall(r"`([a-z0-9-]+)`", section))
    options = {f"--{name.replace('_', '-')}" for name in OPTIONS}
    assert options <= set(re.findall(r"`(--[a-z-]+)", text))
