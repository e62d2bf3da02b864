"""Files that are nearly right are read, or refused in words that name them."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import fewview
import numpy as np
import pytest
from fewview.errors import FormatError

from .mutations import mutated
from .test_hdf5_of_others import WALKS, netcdf, nwb
from .test_named_joints import VISION, joints, label_studio_task

COUNT = int(os.environ.get("FEWVIEW_TEST_MUTATIONS", "60"))


def label_studio() -> bytes:
    return json.dumps([label_studio_task(0, frame, upload="") for frame in range(6)]).encode()


def labelme() -> bytes:
    shapes = [
        {"label": name, "points": [[at, 2 * at]], "group_id": 1, "shape_type": "point", "score": 1}
        for at, name in enumerate("abcdef")
    ]
    return json.dumps({"shapes": shapes, "imageWidth": 640, "imageHeight": 480}).encode()


def named_joints() -> bytes:
    return json.dumps([joints(0, frame, "listed") for frame in range(6)]).encode()


def apple_vision() -> bytes:
    point = {"location": {"x": 0.5, "y": 0.25}, "confidence": 1}
    frames = [{"bodies": [{"joints": dict.fromkeys(VISION.values(), point)}]} for _ in range(6)]
    return json.dumps(frames).encode()


def nwb_file() -> bytes:
    with TemporaryDirectory() as folder:
        return nwb(Path(folder) / "a.nwb").read_bytes()


def netcdf_file() -> bytes:
    position, confidence = np.swapaxes(WALKS[0, ..., :2], 1, 2)[..., None], WALKS[0, ..., 2:]
    with TemporaryDirectory() as folder:
        return netcdf(Path(folder) / "a.nc", position, confidence).read_bytes()


WRITERS = (label_studio, labelme, named_joints, apple_vision, nwb_file, netcdf_file)


@pytest.mark.parametrize("written", WRITERS)
def test_a_file_that_is_nearly_right(tmp_path: Path, written: Callable[[], bytes]) -> None:
    path = tmp_path / "cam1.file"
    path.write_bytes(written())
    read, size = 0, (640, 480)
    assert fewview.read(path, image_size=size).observed().any()
    for content in mutated(written(), COUNT):
        path.write_bytes(content)
        try:
            capture = fewview.read(path, image_size=size, untrusted=True)
        except FormatError as error:
            assert path.stem in str(error)  # noqa: PT017
        else:
            assert not np.isinf(capture.keypoints).any()
            read += 1
    assert read
