"""What a file that is of no known format looks like, and what to do with it."""

from typing import Any

from fewview.readers.sources import HDF5, NUMPY, ZIP, Source

_DO = "Export the detections of each camera as one of the formats of docs/files.md, or as plain CSV"
_3D = "holds 3D points; Fewview makes 3D from the 2D keypoints of each camera: give those"
_VIDEO = "a video; run a detector on it first, and give what it writes"
_IMAGE = "an image; run a detector on it first, and give what it writes"

_BEGINNINGS = {
    ZIP: f"a zip file without `keypoints.npy`; an npz needs `keypoints`. {_DO}",
    NUMPY: "an .npy array of a shape that is no keypoints: (views, frames, keypoints, 2)",
    b"RIFF": _VIDEO,
    b"\x1aE\xdf\xa3": _VIDEO,
    b"\x89PNG": _IMAGE,
    b"\xff\xd8\xff": _IMAGE,
    b"\x80": f"a pickle; only the CAM_*.pkl of the MV-NRSfM authors are read. {_DO}",
    b"PathFileType": f"a TRC file: it {_3D}",
}


def looks_like(source: Source) -> str:
    """Return a sentence for the error: what this is taken for, and what would be read."""
    if not source.head:
        return f"an empty file. {_DO}"
    if source.begins(HDF5):
        return _of_hdf5(set(source.hdf5))
    if source.head[4:8] == b"ftyp":
        return _VIDEO
    for magic, said in _BEGINNINGS.items():
        if source.begins(magic):
            return said
    return _of_text(source)


def _of_text(source: Source) -> str:
    if source.is_toml:
        return f"a TOML file, such as of a calibration, without keypoints. {_DO}"
    if source.json is not None:
        return _of_json(source.json)
    if source.lines:
        return f"text that begins with {source.lines[0][:60]!r}, no table of keypoints. {_DO}"
    return f"not a format that is known. {_DO}"


def _of_hdf5(names: set[str]) -> str:
    if names == {"tracks"}:
        return f"HDF5 of SLEAP-Anipose: it {_3D}"
    shown = ", ".join(sorted(names)[:6]) or "nothing"
    return f"HDF5 that holds {shown}, neither of DeepLabCut, Anipose nor SLEAP. {_DO}"


def _of_json(content: Any) -> str:
    if isinstance(content, dict):
        shown = ", ".join(list(map(str, content))[:6]) or "nothing"
        return f"JSON with {shown}, no known layout of keypoints. {_DO}"
    if content and isinstance(content[0], dict) and "bbox" in content[0]:
        return "JSON of boxes without keypoints; a pose estimator must follow the detector"
    return f"a JSON list, no known layout of keypoints. {_DO}"
