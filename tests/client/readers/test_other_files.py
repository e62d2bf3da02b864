"""No reader of a file can be brought to read another one."""

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fewview
import h5py
import numpy as np
import pytest
from fewview.errors import FormatError

from tests.client.readers import files

NAMES = files.NAMES
VALUES = files.walk(12)


def analysis(path: Path) -> Path:
    return files.sleap_analysis(path, VALUES[None], ["fly"])


def project(path: Path) -> Path:
    return files.slp(path, VALUES[None])


def fixed(path: Path) -> Path:
    return files.dlc_h5_fixed(path, files.columns(NAMES), VALUES.reshape(12, -1))


def appendable(path: Path) -> Path:
    return files.dlc_h5_table(path, files.columns(NAMES), VALUES.reshape(12, -1))


WRITERS = (analysis, project, fixed, appendable)


def datasets(path: Path) -> list[str]:
    """Return the paths of all datasets of a file."""
    names: list[str] = []
    with h5py.File(path, "r") as file:
        file.visit(names.append)
        return [name for name in names if isinstance(file[name], h5py.Dataset)]


def external_link(file: Any, name: str, other: Path) -> None:
    del file[name]
    file[name] = h5py.ExternalLink(str(other), f"/{name}")


def soft_link(file: Any, name: str, other: Path) -> None:
    file.move(name, "elsewhere")
    file[name] = h5py.SoftLink("/elsewhere")


def dangling_link(file: Any, name: str, other: Path) -> None:
    file[f"{name}_other"] = h5py.SoftLink("/nowhere")


def external_storage(file: Any, name: str, other: Path) -> None:
    old = file[name]
    shape, kind = old.shape, old.dtype
    attributes = dict(old.attrs)
    del file[name]
    made = file.create_dataset(name, shape, kind, external=[(str(other), 0, h5py.h5s.UNLIMITED)])
    made.attrs.update(attributes)


def virtual_dataset(file: Any, name: str, other: Path) -> None:
    old = file[name]
    layout = h5py.VirtualLayout(old.shape, old.dtype)
    if old.shape:
        layout[...] = h5py.VirtualSource(str(other), name, old.shape)
    del file[name]
    file.create_virtual_dataset(name, layout)


def references(file: Any, name: str, other: Path) -> None:
    file.move(name, "elsewhere")
    file.create_dataset(name, data=np.full(3, file["elsewhere"].ref, h5py.ref_dtype))


def reference_in_an_attribute(file: Any, name: str, other: Path) -> None:
    file[name].attrs["name"] = file[name].ref


WAYS = (
    external_link, soft_link, dangling_link, external_storage, virtual_dataset, references,
    reference_in_an_attribute,
)  # fmt: skip


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("way", WAYS)
def test_hdf5_files_that_lead_elsewhere_are_refused(
    way: Callable[[Any, str, Path], None], write: Callable[[Path], Path], tmp_path: Path
) -> None:
    """Wherever in the file: each of its datasets is tried."""
    other = write(tmp_path / "other.h5")
    honest = fewview.read(other)
    tried = 0
    for name in datasets(other):
        path = write(tmp_path / "sent.h5")
        with h5py.File(path, "r+") as file:
            if way is external_storage and file[name].dtype.hasobject:
                continue  # HDF5 itself takes no text of any length there
            way(file, name, other)
        with pytest.raises(FormatError, match=r"link|virtual|external|references"):
            fewview.read(path)
        packed = tmp_path / "sent.zip"
        with zipfile.ZipFile(packed, "w") as archive:
            archive.write(path, "cameras/sent.h5")
        with pytest.raises(FormatError):
            fewview.read(packed)
        path.unlink()
        tried += 1
    assert tried
    np.testing.assert_array_equal(fewview.read(other).keypoints, honest.keypoints)


def test_circles_filters_of_others_and_depth_are_refused_or_passed(tmp_path: Path) -> None:
    circle = analysis(tmp_path / "circle.h5")
    with h5py.File(circle, "r+") as file:
        file["self"] = file["/"]
    assert fewview.read(circle).frames == 12
    deep = analysis(tmp_path / "deep.h5")
    with h5py.File(deep, "r+") as file:
        file.create_group("/".join("g" * 100))
    with pytest.raises(FormatError, match="within each other"):
        fewview.read(deep)
    odd = analysis(tmp_path / "odd.h5")
    with h5py.File(odd, "r+") as file:
        creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        creation.set_chunk((4,))
        creation.set_filter(32013, h5py.h5z.FLAG_OPTIONAL)
        space = h5py.h5s.create_simple((8,))
        h5py.h5d.create(file.id, b"packed", h5py.h5t.NATIVE_DOUBLE, space, creation)
    with pytest.raises(FormatError, match="compressed by a filter"):
        fewview.read(odd)


def test_zip_files_cannot_nest_folders_without_end(tmp_path: Path) -> None:
    path = tmp_path / "deep.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/" * 1500 + "cam.csv", "x")
    with pytest.raises(FormatError, match=r"deep\.zip: has more than 32 folders within"):
        fewview.read(path)


@pytest.mark.parametrize("count", [20_000, 70_000])
def test_tables_of_very_many_columns_take_no_time(count: int, tmp_path: Path) -> None:
    """They are read, or refused for their count; in step with their columns, not their square."""
    header = ",".join(["frame", *(f"k{n}_{axis}" for n in range(count // 2) for axis in "xy")])
    row = ",".join(["500"] * count)
    path = tmp_path / "wide.csv"
    path.write_text("\n".join([header, f"0,{row}", f"1,{row}"]))
    if count > 2**16:
        with pytest.raises(FormatError, match="has 70,001 columns, more than the 65,536"):
            fewview.read(path)
    else:
        assert fewview.read([path, path]).keypoints.shape == (2, 2, count // 2, 2)


def test_crowds_without_names_are_refused(tmp_path: Path) -> None:
    """To follow people takes the square of their number."""
    crowd = [list(files.walk(257, 25))] * 2
    files.openpose(tmp_path / "cam", crowd)
    with pytest.raises(FormatError, match="257 people in one frame are more than the 256"):
        fewview.read(tmp_path / "cam")
