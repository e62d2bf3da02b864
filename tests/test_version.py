"""One version: pyproject.toml has it, and whatever users look at agrees."""

import json
import re
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
VERSION = str(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"])


@pytest.mark.parametrize(
    ("file", "written"),
    [
        ("client/pyproject.toml", r'^version = "(.+)"'),
        ("pyproject.toml", r'"fewview==(.+)"'),
        ("Dockerfile", r'image\.version="(.+)"'),
        ("deploy/kubernetes/kustomization.yaml", r'newTag: "(.+)"'),
    ],
)
def test_a_file_has_the_version_of_the_server(file: str, written: str) -> None:
    assert re.findall(written, (ROOT / file).read_text(), re.MULTILINE) == [VERSION]


def test_the_document_and_both_packages_have_it() -> None:
    document = json.loads((ROOT / "docs" / "openapi.json").read_text())
    assert document["info"]["version"] == VERSION
    # `fewview --version`, `GET /version` and `fewview serve` print these.
    assert {version("fewview"), version("fewview-server")} == {VERSION}
