"""Arrays that lie in files and are worked on in blocks: nobody sees it, but for the memory."""

import dataclasses
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fewview
import numpy as np
import pytest
from fewview.errors import FormatError
from fewview.readers import large_arrays
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as drawn
from typer.testing import CliRunner

from tests.odd_arrays import PIXELS, bounded

from . import files

FEET = ("nose", "left_heel", "right_heel", "left_big_toe", "right_big_toe")
ONE, OTHER = files.walk(30, 5), files.walk(30, 5, start=300, seed=2)
ONE[3, 1], ONE[4, 2] = (np.nan, np.nan, 0), (0, 0, 0.9)


def csv(path: Path, values: files.Array, *, names: Any = FEET, people: Any = ()) -> Path:
    labels = files.columns(names, people)
    return files.dlc_csv(path, labels, values.reshape(len(values), len(labels)))


def two_cameras(folder: Path, values: files.Array = ONE) -> Path:
    csv(folder / "a.csv", values)
    csv(folder / "b.csv", OTHER[:20], names=("paw", *FEET[:0:-1]))
    return folder


def sure(folder: Path, highest: float, count: int) -> Path:
    values = ONE.copy()
    values[:count, 0, 2] = highest
    return two_cameras(folder, values)


def shares(folder: Path) -> Path:
    csv(folder / "a.csv", ONE * (1e-3, 1e-3, 1))
    return folder


def animals(folder: Path) -> Path:
    rows = np.stack([ONE, OTHER], 1).reshape(30, -1)
    labels = files.columns(FEET, ("mouse", "single"))
    files.dlc_csv(folder / "a.csv", labels, rows)
    labels[15:] = [(net, who, f"{part}_of_box", axis) for net, who, part, axis in labels[15:]]
    files.dlc_csv(folder / "b.csv", labels, rows)
    return folder


def people(folder: Path) -> Path:
    for name in ("a", "b"):
        turns = [[one, other][:: 1 - 2 * (n % 2)] for n, (one, other) in enumerate(PEOPLE)]
        turns[7] = [turns[7][0]]
        files.openpose(folder / name, turns)
    return folder


PEOPLE = list(zip(files.walk(12, 25), files.walk(12, 25, start=400, seed=2), strict=True))


def tidy(folder: Path) -> Path:
    rows = [
        f"{n},{camera},{name},{','.join(map(str, values[n, k]))}"
        for n in range(30)
        for camera, values in (("left", ONE), ("right", OTHER))
        for k, name in enumerate(FEET)
        if (n, k) != (9, 2)
    ]
    lines = ["frame,camera,keypoint,x,y,confidence", *rows[::-1], ""]
    (folder / "a.csv").write_text("\n".join(lines))
    return folder


def wide(folder: Path) -> Path:
    names = ",".join(f"{name}_{axis}" for name in FEET for axis in "yx")
    for name, values in (("a", ONE), ("b", OTHER)):
        rows = values[:, :, 1::-1].reshape(30, -1).tolist()
        lines = [f"{n / 50},{','.join(map(str, row))}" for n, row in enumerate(rows)]
        (folder / f"{name}.csv").write_text("\n".join([f"time,{names}", *lines, ""]))
    return folder


CASES: dict[str, tuple[Any, dict[str, Any]]] = {
    "two cameras": (two_cameras, {}),
    "weak detections": (two_cameras, {"min_confidence": 0.7}),
    "turned images": (two_cameras, {"y": "up", "mirror": "b"}),
    "few confidences above 1": (lambda folder: sure(folder, 9, 1), {}),
    "many confidences above 1": (lambda folder: sure(folder, 9, 12), {}),
    "confidences slightly above 1": (lambda folder: sure(folder, 1.05, 12), {}),
    "shares of images": (shares, {"image_size": "640x480"}),
    "animals": (animals, {}),
    "one animal": (animals, {"person": "single"}),
    "people in any order": (people, {"skeleton": "body-25"}),
    "cameras of one file": (tidy, {}),
    "without confidences": (wide, {}),
}


@contextmanager
def in_files(block: int) -> Iterator[None]:
    """Have every array lie in a file, and blocks be of so many bytes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(large_arrays, "LARGE", 0)
        patch.setattr(large_arrays, "BLOCK", block)
        yield


def same(one: fewview.Capture, other: fewview.Capture) -> None:
    assert one.notes == other.notes
    assert one.image_sizes == other.image_sizes
    expected, found = one.arrays(), other.arrays()
    assert expected.keys() == found.keys()
    for name, array in expected.items():
        assert array.dtype == found[name].dtype
        np.testing.assert_array_equal(array, found[name], strict=True)


@pytest.mark.parametrize("block", [1, 1000])
@pytest.mark.parametrize("case", CASES)
def test_blocks_change_nothing(tmp_path: Path, case: str, block: int) -> None:
    write, options = CASES[case]
    write(tmp_path)
    expected = fewview.read(tmp_path, **options)
    with in_files(block):
        same(expected, fewview.read(tmp_path, **options))


TABLES = drawn.arrays(
    np.float32, st.tuples(st.integers(1, 9), st.just(5), st.just(2)), elements=PIXELS
)
SURE = drawn.arrays(np.float32, (9, 5), elements=st.sampled_from([0, 0.5, 1, 1.05, 7, -1, np.nan]))


@bounded
@given(one=TABLES, other=TABLES, confidence=SURE, block=st.integers(1, 500))
def test_blocks_change_nothing_of_any_table(
    tmp_path_factory: pytest.TempPathFactory,
    one: files.Array,
    other: files.Array,
    confidence: files.Array,
    block: int,
) -> None:
    folder = tmp_path_factory.mktemp("tables")
    for name, points in (("a", one), ("b", other)):
        csv(folder / f"{name}.csv", np.dstack([points, confidence[: len(points)]]))
    try:
        expected = fewview.read(folder, min_confidence=0.3)
    except FormatError as error:
        with in_files(block), pytest.raises(FormatError) as refused:
            fewview.read(folder, min_confidence=0.3)
        assert str(refused.value) == str(error)  # noqa: PT017
    else:
        with in_files(block):
            same(expected, fewview.read(folder, min_confidence=0.3))


@pytest.mark.parametrize("block", [1, 1000])
def test_what_convert_writes_is_what_numpy_would(tmp_path: Path, block: int) -> None:
    from fewview.cli import app

    wide(tmp_path)
    capture = fewview.read(tmp_path, fps=50, image_size="640x480")
    np.savez(tmp_path / "expected.npz", allow_pickle=False, **capture.arrays())
    out = tmp_path / "out.npz"
    command = ["convert", str(tmp_path / "a.csv"), str(tmp_path / "b.csv"), "-o", str(out)]
    with in_files(block):
        shown = CliRunner().invoke(app, [*command, "--fps", "50", "--image-size", "640x480"])
    assert shown.exit_code == 0, shown.output
    with np.load(tmp_path / "expected.npz") as expected, np.load(out) as found:
        assert list(expected) == list(found)
        for name in expected:
            np.testing.assert_array_equal(expected[name], found[name], strict=True)


def test_files_of_arrays_have_no_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    with in_files(1000):
        capture = fewview.read(two_cameras(tmp_path))
    assert not list(temporary.iterdir())
    changed = dataclasses.replace(capture, keypoints=capture.keypoints)
    changed.keypoints[0] = 7  # as any array
    assert (changed.keypoints[0] == 7).all()


def test_a_disk_without_room_is_a_reason(tmp_path: Path) -> None:
    two_cameras(tmp_path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    with in_files(1000):
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
        try:
            with pytest.raises(FormatError, match=r"no room for what is read .*TMPDIR"):
                fewview.read(tmp_path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_is_given_back_block_by_block() -> None:
    def mapped() -> int:
        """Return bytes of files that are in this process's memory."""
        pages = int(Path("/proc/self/statm").read_text().split()[2])
        return pages * resource.getpagesize()

    before = mapped()
    size = 2 * large_arrays.LARGE
    array = large_arrays.gathered(np.ones((size // 256, 4), np.float32) for _ in range(16))
    most = 0
    for block in large_arrays.blocks(array):
        array[block] += 1
        most = max(most, mapped())
    assert most - before < size / 4
    assert (array == 2).all()
