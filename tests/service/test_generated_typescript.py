"""The TypeScript program over a generated client, against a running service."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from models.capture.synthetic import SyntheticCapture
from tests.node import install, node
from tests.service.conftest import Live, frames_of

ROOT = Path(__file__).parents[2]
PACKAGES = ("openapi-typescript@7", "openapi-fetch@0.17", "typescript@5", "@types/node@22")
BIN = "node_modules/.bin"
STRICT = ("--strict", "--noUncheckedIndexedAccess", "--module", "nodenext", "--target", "es2022")


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder with what a project in TypeScript installs; skip where that cannot be had."""
    folder = tmp_path_factory.mktemp("project")
    (folder / "package.json").write_text('{"type": "module", "private": true}')
    install(folder, "install", "--no-audit", "--no-fund", *PACKAGES)
    return folder


@pytest.mark.thorough
def test_a_program_in_typescript_does_the_whole_job(
    project: Path, live: Live, capture: SyntheticCapture
) -> None:
    spec = str(ROOT / "docs" / "openapi.json")
    options = ("--default-non-nullable", "false")
    node(project, f"{BIN}/openapi-typescript", spec, *options, "-o", "fewview.d.ts")
    shutil.copy(ROOT / "examples" / "generated_client.ts", project)
    node(project, f"{BIN}/tsc", *STRICT, "generated_client.ts")
    (project / "keypoints.json").write_text(json.dumps(frames_of(capture.keypoints[:40])))
    message = node(project, "generated_client.js", live.url, "keypoints.json", "out.npz")
    with np.load(project / "out.npz") as arrays:
        assert arrays["points3d"].shape == (40, 16, 3)
        np.testing.assert_allclose(json.loads(message), arrays["points3d"][0], atol=1e-4)
