"""Zip files of folders, files of strangers, and the options that all commands share."""

import shutil
import zipfile
from pathlib import Path

import fewview
import numpy as np
import pytest
from fewview.errors import FormatError
from typer.testing import CliRunner

from . import files


def zipped(folder: Path) -> Path:
    return Path(shutil.make_archive(str(folder), "zip", folder))


def test_a_zip_file_stands_for_a_folder(tmp_path: Path) -> None:
    one, other = files.walk(6, 25), files.walk(6, 25, start=300, seed=2)
    rig = tmp_path / "rig"
    folders = [
        files.openpose(rig / name, [[frame] for frame in body])
        for name, body in (("left", one), ("right", other))
    ]
    expected = fewview.read(folders).keypoints
    each = fewview.read([zipped(folder) for folder in folders])
    np.testing.assert_array_equal(each.keypoints, expected)
    assert each.view_names == ("left", "right")
    shutil.rmtree(rig / "__MACOSX", ignore_errors=True)
    for path in rig.glob("*.zip"):
        path.unlink()
    shutil.copytree(rig, tmp_path / "outer" / "session")
    (tmp_path / "outer" / ".hidden").write_text("no keypoints")
    both = fewview.read(zipped(tmp_path / "outer"))  # all cameras in one, a folder deeper
    np.testing.assert_array_equal(both.keypoints, expected)


def test_zip_files_that_are_not_to_be_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = zipped(files.openpose(tmp_path / "cam", [[body] for body in files.walk(6, 25)]))
    (tmp_path / "cut.zip").write_bytes(whole.read_bytes()[:-30])
    with pytest.raises(FormatError, match=r"cut\.zip: a zip file or npz that is broken"):
        fewview.read(tmp_path / "cut.zip")
    outside = tmp_path / "outside.zip"
    with zipfile.ZipFile(outside, "w") as archive:
        archive.writestr("../../outside.txt", "x")
    with pytest.raises(FormatError):
        fewview.read(outside)
    assert not list(tmp_path.parent.rglob("outside.txt"))
    long = tmp_path / "long.zip"
    with zipfile.ZipFile(long, "w") as archive:
        archive.writestr(f"cam/{'n' * 300}.csv", "0,1")
    with pytest.raises(FormatError, match=r"cannot be read \([^/]+\)$"):  # no folder of ours
        fewview.read(long)
    monkeypatch.setattr("fewview.readers.archives.MAX_UNPACKED", 100)
    with pytest.raises(FormatError, match="part it"):
        fewview.read(whole)


def test_names_of_views_are_in_what_convert_writes(tmp_path: Path) -> None:
    folders = [
        files.openpose(tmp_path / name, [[body] for body in files.walk(6, 25)])
        for name in ("left", "right")
    ]
    np.savez(tmp_path / "both.npz", allow_pickle=False, **fewview.read(folders).arrays())
    assert fewview.read(tmp_path / "both.npz").view_names == ("left", "right")


def test_what_a_reader_has_to_trust_is_not_read_of_strangers(tmp_path: Path) -> None:
    c3d = tmp_path / "a.c3d"
    c3d.write_bytes(b"\x02\x50" + bytes(1024))
    with pytest.raises(FormatError, match=r"fewview convert a\.c3d -o capture.npz"):
        fewview.read(c3d, untrusted=True)


@pytest.mark.parametrize("command", ["convert", "run", "upload", "lift"])
def test_all_commands_that_read_take_the_same_options(command: str, tmp_path: Path) -> None:
    from fewview.cli import app

    words = {"lift": ["mdl_1"]}.get(command, [])
    path = files.dlc_csv(
        tmp_path / "a.csv", files.columns(files.NAMES), files.walk(6).reshape(6, 12)
    )
    out = [] if command == "upload" else ["-o", str(tmp_path / "out.npz")]
    options = ["--format=deeplabcut-csv", "--person=auto", "--min-confidence=0.1", "--align=index"]
    for wrong, message in (
        (["--image-size=big"], "expected WIDTHxHEIGHT"),
        (["--fps=-1"], "fps: '-1' is not above 0"),
        (["--skeleton=cat", "--format=deeplabcut-csv"], "no skeleton"),
    ):
        shown = CliRunner().invoke(app, [command, *words, str(path), *out, *options, *wrong])
        assert shown.exit_code == 2, shown.stderr
        assert message in shown.stderr
        assert len(shown.stderr.splitlines()) == 1
