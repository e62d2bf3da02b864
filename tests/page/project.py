"""The page's sources in a folder of their own, with all that their own checks need."""

import shutil
from pathlib import Path

import pytest

from tests.node import install, node
from tests.sharing import made_once

ROOT = Path(__file__).parents[2]


def checked_out(folders: pytest.TempPathFactory) -> Path:
    """Return the copy that all test processes of a run share; skip where it cannot be made."""

    def make() -> bytes:
        return str(_installed(folders.mktemp("page"))).encode()

    return Path(made_once(folders, "page", make).decode())


def _installed(folder: Path) -> Path:
    """Copy the sources and install what the lockfile names."""
    page = folder / "page"
    shutil.copytree(ROOT / "page", page, ignore=shutil.ignore_patterns("node_modules"))
    (folder / "docs").mkdir()
    shutil.copy(ROOT / "docs" / "openapi.json", folder / "docs")
    install(page, "ci", "--ignore-scripts", "--prefer-offline")
    tool = "node_modules/openapi-typescript/bin/cli.js"
    options = ("--default-non-nullable", "false", "-o", "src/api/openapi.d.ts")
    node(page, tool, "../docs/openapi.json", *options)
    return page
