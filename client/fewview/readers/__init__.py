"""Formats in: files of 2D keypoints, as detectors and annotation tools write them, as a `Capture`.

`reading.py` is the way through: paths become sources (`sources.py`), a source finds its format
(`registry.py`) and is read into views (`views.py`, one module a format in `formats/`); one person
is picked, the same in all cameras (`people.py`, `matching.py`), and the views are put side by side
(`combining.py`). A new format is a module in `formats/` and a line in `registry.py`.
"""

from fewview.readers.reading import read, read_with

__all__ = ["read", "read_with"]
