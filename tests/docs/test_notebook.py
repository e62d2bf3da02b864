"""The notebook, run from its first cell to its last, with fewer frames and steps."""

import base64
import io
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient
from PIL import Image

from tests.service.conftest import kill_service, start_service

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.thorough
def test_the_notebook_ends_in_an_animation(tmp_path: Path) -> None:
    notebook: Any = nbformat.read(  # type: ignore[no-untyped-call]
        EXAMPLES / "walk.ipynb", as_version=4
    )
    live = start_service(tmp_path)
    quick = {
        "stack.enter_context(running_service())": repr(live.url),  # others test its start
        "slice(0, 270)": "slice(0, 140)",
        "steps=300": "steps=40, dictionary_sizes=[16, 8], batch_size=16, distillation=False",
        "frames=20": "frames=5",
    }
    for written, instead in quick.items():
        (cell,) = [cell for cell in notebook.cells if written in cell.source]
        cell.source = cell.source.replace(written, instead)
    try:
        NotebookClient(notebook, timeout=300, resources={"metadata": {"path": EXAMPLES}}).execute()
    finally:
        kill_service(live)
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    printed = "".join(output.text for output in outputs if output.output_type == "stream")
    assert "static cameras" in printed
    assert "PA-MPJPE" in printed
    with Image.open(io.BytesIO(base64.b64decode(outputs[-1].data["image/gif"]))) as film:
        film.seek(4)  # raises where it is shorter
