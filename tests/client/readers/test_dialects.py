"""Tables in any hand: whatever separates cells and however numbers are spelled, it is the same."""

import zipfile
from collections.abc import Callable
from itertools import product
from pathlib import Path

import fewview
import numpy as np
import pytest
from fewview.errors import FormatError
from numpy.typing import NDArray

from . import files

NAMES = ("nose", "tail", "hüfte", "ear")
XYZ = files.walk(8)
XYZ[3, 1] = (np.nan, np.nan, 0)
Cells = list[list[str]]
Layout = Callable[[str, str], Cells]  # of a decimal point, and what stands for nothing
ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "cp1252")


def number(value: float, decimal: str, nothing: str) -> str:
    return nothing if np.isnan(value) else f"{value:.5f}".replace(".", decimal)


def dlc(decimal: str, nothing: str) -> Cells:
    rows = [["scorer", *["net"] * 12], ["bodyparts", *np.repeat(NAMES, 3)]]
    rows.append(["coords", *["x", "y", "likelihood"] * 4])
    return rows + [
        [str(n), *(number(v, decimal, nothing) for v in frame.ravel())]
        for n, frame in enumerate(XYZ)
    ]


def wide(decimal: str, nothing: str) -> Cells:
    rows = [["frame", *(f"{n}_{a}" for n in NAMES for a in ("x", "y", "confidence"))]]
    return rows + [
        [str(n), *(number(v, decimal, nothing) for v in frame.ravel())]
        for n, frame in enumerate(XYZ)
    ]


def tidy(decimal: str, nothing: str) -> Cells:
    rows = [["frame", "keypoint", "x", "y", "confidence"]]
    return rows + [
        [str(n), name, *(number(v, decimal, nothing) for v in point)]
        for n, frame in enumerate(XYZ)
        for name, point in zip(NAMES, frame, strict=True)
    ]


def written(
    path: Path, rows: Cells, separator: str, encoding: str = "utf-8", eol: str = "\n"
) -> Path:
    path.write_bytes("".join(separator.join(row) + eol for row in rows).encode(encoding))
    return path


def assert_read(path: Path, names: tuple[str, ...] | None = NAMES) -> None:
    capture = fewview.read(path)
    assert capture.keypoint_names == names
    np.testing.assert_allclose(capture.keypoints[:, 0], XYZ[..., :2], atol=1e-4)
    assert capture.confidence is not None
    np.testing.assert_allclose(capture.confidence[:, 0], XYZ[..., 2], atol=1e-4)


@pytest.mark.parametrize("layout", [dlc, wide, tidy])
def test_every_dialect_reads_the_same(tmp_path: Path, layout: Layout) -> None:
    hands = product(((",", "."), (";", ","), (";", "."), ("\t", ","), ("|", ".")), ENCODINGS)
    endings = ("\n", "\r\n", "\r")
    spellings = ("", "NaN", "nan", "NA", "-", "#N/A", "null")
    for place, ((separator, decimal), encoding) in enumerate(hands):
        rows = layout(decimal, spellings[place % len(spellings)])
        eol = endings[place % len(endings)]
        assert_read(written(tmp_path / f"{place}.csv", rows, separator, encoding, eol))


@pytest.mark.parametrize("layout", [dlc, wide])
@pytest.mark.parametrize("separator", [",", ";"])
def test_what_spreadsheets_add_is_no_frame(tmp_path: Path, layout: Layout, separator: str) -> None:
    rows: Cells = layout(".", "")
    blank = [""] * len(rows[0])
    filled = written(tmp_path / "blank.csv", [*rows, blank, blank], separator)
    assert_read(filled)
    text = filled.read_text()
    filled.write_text(f"sep={separator}\n{text}")
    assert_read(filled)
    filled.write_text(f'"sep={separator}"{separator * 12}\n{text}')
    assert_read(filled)
    assert_read(written(tmp_path / "trailing.csv", [[*row, ""] for row in rows], separator))


def test_quoted_cells_have_decimal_commas(tmp_path: Path) -> None:
    rows = [[f'"{cell}"' for cell in row] for row in dlc(",", "")]
    assert_read(written(tmp_path / "a.csv", rows, ","))


def test_index_columns_that_were_named_or_lost(tmp_path: Path) -> None:
    rows = dlc(".", "")
    named = [*rows[:3], ["frame", *[""] * 12], *rows[3:]]
    assert_read(written(tmp_path / "named.csv", named, ","))
    assert_read(written(tmp_path / "lost.csv", [row[1:] for row in rows], ","))
    jarvis = [row[1:] for row in rows[1:]]
    assert_read(written(tmp_path / "data2D.csv", jarvis, ","))
    assert_read(written(tmp_path / "bare.csv", jarvis[1:], ","), None)
    r = [wide(".", "NA")[0][1:], *wide(".", "NA")[1:]]  # R does not name the rows' names
    assert_read(written(tmp_path / "r.csv", r, "\t"))


def test_what_stands_above_the_numbers(tmp_path: Path) -> None:
    rows = wide(".", "")
    remarks = [["# walk 3"], ["# by somebody; 50 fps"]]
    assert_read(written(tmp_path / "remarks.csv", [*remarks, *rows], ","))
    units = ["frames", *["px", "px", "-"] * 4]
    assert_read(written(tmp_path / "units.csv", [rows[0], units, *rows[1:]], ","))
    merged = [["", *(c for n in NAMES for c in (n, "", ""))], ["frame", *["X", "Y", "score"] * 4]]
    assert_read(written(tmp_path / "merged.csv", [*merged, *rows[1:]], ";"))
    assert_read(written(tmp_path / "blanks.txt", wide(".", "nan"), "  "))


def test_rows_without_an_entry_are_frames_where_nothing_counts_them(tmp_path: Path) -> None:
    rows = [row[1:] for row in wide(".", "")]
    rows[4] = [""] * 12
    rows += [[""] * 12] * 3  # and none at the end
    capture = fewview.read(written(tmp_path / "a.csv", rows, ","))
    assert capture.frames == len(XYZ)
    assert np.isnan(capture.keypoints[3]).all()


def test_a_long_table_may_change_its_hand(tmp_path: Path) -> None:
    """Its rows are read some thousands at a time: those with words, quotes and blanks, too."""
    body = files.walk(12000)
    body[::97, 1] = (np.nan, np.nan, 0)
    names = [f"{n}_{a}" for n in NAMES for a in ("x", "y", "confidence")]
    rows = [["frame", *names]]
    for n, frame in enumerate(body):
        cells = [number(v, ".", "" if n < 4500 else "NA") for v in frame.ravel()]
        rows.append([str(n), *(f'"{cell}"' if n > 9000 else cell for cell in cells)])
        rows += [[""] * 13] * (n % 5000 == 7)
    capture = fewview.read(written(tmp_path / "a.csv", rows, ","))
    np.testing.assert_allclose(capture.keypoints[:, 0], body[..., :2], atol=1e-4)


@pytest.mark.parametrize("odd", ["inf", "37.2"])
def test_one_odd_confidence_is_no_scale(tmp_path: Path, odd: str) -> None:
    body = np.concatenate([files.walk(60), files.walk(60)], axis=1)
    names = [f"{n}{k}" for k in range(2) for n in files.NAMES]
    labels = files.columns(names)
    path = files.dlc_csv(tmp_path / "a.csv", labels, body.reshape(60, -1))
    lines = path.read_text().splitlines()
    cells = lines[20].split(",")
    cells[3] = odd
    path.write_text("\n".join([*lines[:20], ",".join(cells), *lines[21:]]))
    capture = fewview.read(path)
    assert capture.confidence is not None
    expected = body[..., 2].copy()
    expected[17, 0] = 1
    np.testing.assert_allclose(capture.confidence[:, 0], expected, rtol=1e-5)


HEADERS = {
    "x_nose,y_nose,p_nose,x_tail,y_tail,p_tail": ("nose", "tail"),
    "x1,y1,v1,x2,y2,v2": None,
    "noseX,noseY,noseScore,tailX,tailY,tailScore": ("nose", "tail"),
    "nose[x],nose[y],nose[p],tail[x],tail[y],tail[p]": ("nose", "tail"),
    "nose:x,nose:y,nose:conf,tail:x,tail:y,tail:conf": ("nose", "tail"),
    "nose_x (px),nose_y (px),nose_c,tail_x (px),tail_y (px),tail_c": ("nose", "tail"),
    "nose_u,nose_v,nose_score,tail_u,tail_v,tail_score": ("nose", "tail"),
    "NOSE.x,NOSE.y,NOSE.likelihood,TAIL.x,TAIL.y,TAIL.likelihood": ("NOSE", "TAIL"),
}


@pytest.mark.parametrize("header", HEADERS)
def test_columns_in_many_spellings(tmp_path: Path, header: str) -> None:
    rows = [header.split(",")]
    rows += [[f"{v:.5f}" for v in frame[:2].ravel()] for frame in XYZ[4:]]
    capture = fewview.read(written(tmp_path / "a.csv", rows, ","))
    assert capture.keypoint_names == HEADERS[header]
    np.testing.assert_allclose(capture.keypoints[:, 0], XYZ[4:, :2, :2], atol=1e-4)
    assert capture.confidence is not None
    np.testing.assert_allclose(capture.confidence[:, 0], XYZ[4:, :2, 2], atol=1e-4)


def test_columns_are_mapped_as_was_asked(tmp_path: Path) -> None:
    header = ["No", *(f"{a} von {n}" for n in NAMES for a in ("Spalte", "Zeile", "sicher"))]
    rows = [header, *wide(".", "")[1:]]
    path = written(tmp_path / "a.csv", rows, ";")
    with pytest.raises(
        FormatError, match=r"plain CSV.*columns='x=Spalte von \{\},y=Zeile von \{\}"
    ):
        fewview.read(path)
    mapping = "x=Spalte von {},y=Zeile von {},confidence=sicher von {},frame=No"
    capture = fewview.read(path, columns=mapping)
    assert capture.keypoint_names == NAMES
    np.testing.assert_allclose(capture.keypoints[:, 0], XYZ[..., :2], atol=1e-4)
    for wrong, why in (("x={}", "no columns of x and y"), ("q={}", "ROLE"), ("x=a{}", "no column")):
        with pytest.raises(FormatError, match=why):
            fewview.read(path, columns=wrong)


def test_what_cannot_be_read_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no columns of x and y"):
        fewview.read(written(tmp_path / "walk.csv", dlc(".", ""), ","), format="csv")
    (tmp_path / "walk.csv").unlink()
    numbers = written(tmp_path / "cam1.csv", wide(".", "NaN")[1:3], ",")
    for given in (numbers, tmp_path):
        with pytest.raises(FormatError, match="numbers without a header; write the names"):
            fewview.read(given)
    with zipfile.ZipFile(tmp_path / "book.xlsx", "w") as book:
        book.writestr("xl/workbook.xml", "<workbook/>")
    with pytest.raises(FormatError, match="save the sheet of each camera as CSV"):
        fewview.read(tmp_path / "book.xlsx")


def pairs(cameras: int) -> NDArray[np.float64]:
    return np.stack([files.walk(6, seed=v, start=100 * v + 50)[..., :2] for v in range(cameras)], 1)


@pytest.mark.parametrize(
    "spelling", ["pt{k}_cam{v}_{a}", "Track {k}_cam_{v}_{a}", "cam{v}_p{k}_{a}"]
)
def test_columns_that_name_cameras(tmp_path: Path, spelling: str) -> None:
    """As DLTdv and Argus write them: all cameras in one file."""
    seen = pairs(3)
    header = [
        spelling.format(k=k + 1, v=v + 1, a=a) for k in range(4) for v in range(3) for a in "XY"
    ]
    rows = [header, *([f"{x:.4f}" for x in frame.transpose(1, 0, 2).ravel()] for frame in seen)]
    capture = fewview.read(written(tmp_path / "walkxypts.csv", rows, ","))
    assert capture.view_names == ("cam1", "cam2", "cam3")
    np.testing.assert_allclose(capture.keypoints, seen, atol=1e-3)
    assert capture.keypoint_names is not None
    assert len(capture.keypoint_names) == 4


def test_rows_that_name_cameras_and_points_by_numbers(tmp_path: Path) -> None:
    """As caliscope writes them; each camera has a clock of its own."""
    seen = pairs(2)
    rows = [["sync_index", "port", "frame_index", "frame_time", "point_id", "img_loc_x"]]
    rows[0] += ["img_loc_y", "obj_loc_x", "obj_loc_y"]
    for n, (v, k) in product(range(6), product(range(2), reversed(range(4)))):
        x, y = seen[n, v, k]
        rows.append(
            [str(n), str(v), str(n + 7), f"{n / 50 + v / 1000}", str(k), f"{x}", f"{y}", "", ""]
        )
    capture = fewview.read(written(tmp_path / "xy.csv", rows, ","))
    np.testing.assert_allclose(capture.keypoints, seen, atol=1e-3)
    assert capture.times is not None
    np.testing.assert_allclose(capture.times[:, 1] - capture.times[:, 0], 1 / 1000)


@pytest.mark.parametrize("visible", [True, False])
@pytest.mark.parametrize("spelling", ["{n}_{a}", "{a}{k}"])
def test_landmarks_have_a_depth_that_is_none(tmp_path: Path, visible: bool, spelling: str) -> None:
    names = fewview.readers.skeletons.SKELETONS["mediapipe-33"].names
    body = files.walk(6, 33) / 400
    axes = "xyzv" if visible and "k" in spelling else ("x", "y", "z", *["visibility"] * visible)
    rows = [[spelling.format(n=n.upper(), k=k + 1, a=a) for k, n in enumerate(names) for a in axes]]
    rows += [
        [f"{v:.6f}" for x, y, c in frame for v in (x, y, -0.1, c)[: len(axes)]] for frame in body
    ]
    path = written(tmp_path / "a.csv", rows, ",")
    capture = fewview.read(path, image_size=(1000, 500))
    np.testing.assert_allclose(capture.keypoints[:, 0], body[..., :2] * (1000, 500), atol=1e-2)
    assert "guess of one image" in "\n".join(capture.notes)
    assert capture.edges
    metres = [rows[0], *([f"{4 * float(v) - 1.4:.6f}" for v in row] for row in rows[1:])]
    with pytest.raises(FormatError, match=r"3D points|between -1 and 1"):
        fewview.read(written(tmp_path / "world.csv", metres, ","), image_size=(1000, 500))


def test_a_trc_of_pixels_is_2d(tmp_path: Path) -> None:
    lines = [["PathFileType", "4", "(X/Y/Z)", "a.trc"], ["DataRate", "CameraRate"], ["500", "500"]]
    lines += [["Frame#", "Time", *(c for n in NAMES for c in (n, "", ""))]]
    lines += [["", "", *(f"{a}{k + 1}" for k in range(4) for a in "XYZ")], []]
    for n, frame in enumerate(XYZ):
        fields = [f"{v:.4f}" if np.isfinite(v) else "" for x, y, _ in frame for v in (x, y, 0 * x)]
        lines.append([str(n + 1), f"{n / 500}", *fields])
    lines[-1] = lines[-1][:8]  # the last two are gaps, and their fields are left out
    path = written(tmp_path / "cam1_px.trc", lines, "\t")
    capture = fewview.read(path)
    np.testing.assert_allclose(capture.keypoints[:-1, 0], XYZ[:-1, :, :2], atol=1e-3)
    assert np.isnan(capture.keypoints[-1, 0, 2:]).all()
    assert capture.keypoint_names == NAMES
    assert capture.times is not None
    assert capture.fps == 500
    metres = [
        *lines[:6],
        *([*line[:2], *(f and f"{float(f) / 1000}" for f in line[2:])] for line in lines[6:]),
    ]
    metres[1], metres[2] = ["DataRate", "Units"], ["500", "m"]
    with pytest.raises(FormatError, match="metres"):
        fewview.read(written(tmp_path / "cam1_m.trc", metres, "\t"))
    solid = [*lines[:-1], [*lines[-2][:-1], "9"]]
    solid[-1][0] = str(len(XYZ))
    with pytest.raises(FormatError, match="3D points"):
        fewview.read(written(tmp_path / "room.trc", solid, "\t"))
