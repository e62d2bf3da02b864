"""Whatever stands in a detector's table: it is read as it was written, or refused with a reason."""

from pathlib import Path

import fewview
import numpy as np
import pytest
from fewview.errors import FormatError
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as drawn
from numpy.typing import NDArray

from tests.odd_arrays import PIXELS, bounded

from . import files

SHAPES = st.tuples(st.integers(1, 5), st.just(4), st.just(2))
TABLES = drawn.arrays(np.float32, SHAPES, elements=PIXELS)
# Neither the corner, where detectors put what they do not see, nor shares of the image.
CLEAR = st.one_of(st.just(np.nan), st.floats(16, 2000, width=32))
CLEAR_TABLES = drawn.arrays(np.float32, SHAPES, elements=CLEAR)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tables")


def write(path: Path, points: NDArray[np.float32]) -> Path:
    likelihood = np.full((*points.shape[:2], 1), 0.75)
    values = np.concatenate([points, likelihood], axis=-1).reshape(len(points), -1)
    return files.dlc_csv(path, files.columns(files.NAMES), values)


@bounded
@given(points=CLEAR_TABLES)
def test_a_table_is_read_as_it_was_written(folder: Path, points: NDArray[np.float32]) -> None:
    path = write(folder / "cam.csv", points)
    capture = fewview.read(path)
    whole = np.isfinite(points).all(-1, keepdims=True)  # half a point is none
    np.testing.assert_allclose(capture.keypoints[:, 0], np.where(whole, points, np.nan), rtol=1e-6)


@bounded
@given(points=TABLES, place=st.floats(0, 1), text=st.text(max_size=3), cut=st.booleans())
def test_a_broken_table_is_refused_in_words_or_read(
    folder: Path, points: NDArray[np.float32], place: float, text: str, *, cut: bool
) -> None:
    path = write(folder / "broken.csv", points)
    whole = path.read_bytes()
    at = int(place * len(whole))
    rest = b"" if cut else whole[at + len(text) :]
    path.write_bytes(whole[:at] + text.encode(errors="surrogatepass") + rest)
    try:
        capture = fewview.read(path)
    except FormatError as error:
        assert path.stem in str(error)  # noqa: PT017
    else:
        assert capture.views == 1
        assert not np.isinf(capture.keypoints).any()
