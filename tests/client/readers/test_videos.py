"""Videos that lie beside files: their headers say sizes and rates."""

import struct
from pathlib import Path

import fewview
import numpy as np
import pytest

from . import files

pytest.importorskip("pymediainfo", reason="the extra `video` is not installed")


def chunk(kind: bytes, body: bytes) -> bytes:
    return kind + struct.pack("<I", len(body)) + body + b"\0" * (len(body) % 2)


def avi(path: Path, width: int, height: int, rate: int) -> None:
    """Write the header of an AVI without a single image."""
    main = (10**6 // rate, 0, 0, 16, 12, 0, 1, 0, width, height, 0, 0, 0, 0)
    stream = (b"vids", b"MJPG", 0, 0, 0, 0, 1, rate, 0, 12, 0, 0, 0, 0, 0, width, height)
    form = (40, width, height, 1, 24, b"MJPG", 0, 0, 0, 0, 0)
    lists = b"strl" + chunk(b"strh", struct.pack("<4s4sIHHIIIIIIII4H", *stream))
    lists += chunk(b"strf", struct.pack("<IiiHH4sIiiII", *form))
    head = b"hdrl" + chunk(b"avih", struct.pack("<14I", *main)) + chunk(b"LIST", lists)
    movie = chunk(b"LIST", head) + chunk(b"LIST", b"movi")
    path.write_bytes(chunk(b"RIFF", b"AVI " + movie))


def test_sizes_and_rates_are_those_of_videos(tmp_path: Path) -> None:
    body, labels = files.walk(12), files.columns(files.NAMES)
    for camera, (width, height), rate in (("cam1", (1920, 1080), 60), ("cam2", (480, 640), 30)):
        avi(tmp_path / f"{camera}.avi", width, height, rate)
        seen = body[:: 60 // rate] / (width, height, 1)
        file = tmp_path / f"{camera}DLC_resnet50_walk.csv"
        files.dlc_csv(file, labels, seen.reshape(len(seen), -1))
    (tmp_path / "cam3.avi").write_bytes(b"RIFF\0\0\0\0AVI broken")
    given = sorted(tmp_path.glob("*.csv"))
    capture = fewview.read(given)
    assert capture.image_sizes == ((1920, 1080), (480, 640))
    np.testing.assert_allclose(capture.keypoints[:, 0], body[..., :2], rtol=1e-4)
    np.testing.assert_allclose(capture.keypoints[::2, 1], body[::2, :, :2], rtol=1e-4)
    assert capture.times is not None
    np.testing.assert_allclose(capture.times, np.arange(12) / 60)
    assert "cam1.avi lies beside: 1920 x 1080" in "\n".join(capture.notes)
    asked = fewview.read(given, image_size="100x100", fps=25)
    assert asked.image_sizes == ((100, 100), (100, 100))
    assert asked.fps == 25
