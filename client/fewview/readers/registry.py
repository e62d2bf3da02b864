"""The formats that are known, in the order in which they are tried."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np

from fewview.errors import FormatError
from fewview.readers.formats import (
    c3d,
    coco,
    deeplabcut,
    frames_json,
    label_studio,
    labelme,
    lightning_pose,
    mediapipe,
    movement,
    mvnrsfm,
    npy,
    npz,
    nwb,
    openpose,
    sleap,
    table,
    trc,
    yolo,
)
from fewview.readers.sources import Source
from fewview.readers.unknown_files import unknown
from fewview.readers.views import View


@dataclass(frozen=True)
class Format:
    """A format: its name, its title for people, a test of a source, and its reader.

    If a reader has to trust its files, `trusting` is the reason. `words` are some that its files
    have, in lower case, letters and digits alone; files of unknown formats are compared with them.
    """

    name: str
    title: str
    fits: Callable[[Source], bool]
    read: Callable[[Source], list[View]]
    trusting: str = ""
    words: str = ""


FORMATS = (
    Format("npz", "npz", npz.fits, npz.read),
    Format("deeplabcut-h5", "DeepLabCut or Anipose H5", deeplabcut.fits_h5, deeplabcut.read_h5),
    Format("lightning-pose", "Lightning Pose CSV", lightning_pose.fits, deeplabcut.read_csv),
    Format(
        "deeplabcut-csv",
        "DeepLabCut CSV",
        deeplabcut.fits_csv,
        deeplabcut.read_csv,
        words="scorer individuals bodyparts coords x y likelihood",
    ),
    Format("jarvis", "JARVIS CSV", deeplabcut.fits_jarvis, deeplabcut.read_csv),
    Format(
        "openpose",
        "OpenPose JSON",
        openpose.fits,
        openpose.read,
        words="version people posekeypoints2d handleftkeypoints2d personid",
    ),
    Format("nwb", "NWB", nwb.fits, nwb.read),
    Format("movement", "movement netCDF", movement.fits, movement.read),
    Format("sleap", "SLEAP .slp", sleap.fits_slp, sleap.read_slp),
    Format("sleap-analysis", "SLEAP analysis H5", sleap.fits_analysis, sleap.read_analysis),
    Format(
        "coco",
        "COCO keypoints JSON",
        coco.fits,
        coco.read,
        words="images annotations categories imageid categoryid keypoints numkeypoints filename",
    ),
    Format(
        "mediapipe",
        "MediaPipe JSON",
        mediapipe.fits,
        mediapipe.read,
        words="landmarks poselandmarks poselandmark visibility worldlandmarks",
    ),
    Format(
        "label-studio",
        "Label Studio JSON",
        label_studio.fits,
        label_studio.read,
        words="annotations completions result keypointlabels originalwidth value fileupload",
    ),
    Format(
        "labelme",
        "labelme JSON",
        labelme.fits,
        labelme.read,
        words="shapes shapetype imagepath imagedata imageheight imagewidth flags groupid",
    ),
    *(
        Format(
            each.name,
            each.title,
            partial(frames_json.fits, layout=each),
            partial(frames_json.read, layout=each),
            words=each.words,
        )
        for each in frames_json.LAYOUTS
    ),
    Format("yolo", "YOLO pose labels", yolo.fits, yolo.read),
    Format("npy", "FreeMoCap npy", npy.fits, npy.read),
    Format("mvnrsfm", "CAM_*.pkl of MV-NRSfM", mvnrsfm.fits, mvnrsfm.read, "pickles are programs"),
    Format("c3d", "C3D", c3d.fits, c3d.read, "a broken file can end the process that reads it"),
    Format("trc", "TRC", trc.fits, trc.read, words="pathfiletype datarate camerarate nummarkers"),
    Format(
        "csv",
        "plain CSV",
        table.fits,
        table.read,
        words="frame keypoint x y confidence time camera point joint",
    ),
)
NAMES = tuple(each.name for each in FORMATS)


def detect(source: Source) -> Format | None:
    """Return the format that a source is of, by what is in it; None for none of them.

    Raises
    ------
    FormatError
        If it is broken.
    """
    with _broken(source, lambda: "a broken file"):
        return next((each for each in FORMATS if each.fits(source)), None)


def views_of(
    source: Source, known: Format, *, untrusted: bool = False, columns: str | None = None
) -> list[View]:
    """Read a source's views.

    Parameters
    ----------
    columns
        What the columns of a plain table hold, as `ReadingOptions.columns`.

    Raises
    ------
    FormatError
        If it is broken, or not as the format has it; if it is not to be trusted, and must be.
    """
    if untrusted and known.trusting:
        raise FormatError(
            f"{known.title} is read on your own computer alone, as {known.trusting}: "
            f"`fewview convert {source.path.name} -o capture.npz`, and send that",
            place=source,
        )
    with _broken(source, lambda: f"not as {known.title} should be{_instead(source, known)}"):
        views = known.read(source) if columns is None else table.read(source, columns)
    if not all(len(view.numbers) for view in views):
        raise FormatError(f"{known.title} without a single frame", place=source)
    return views


def _instead(source: Source, known: Format) -> str:
    """Return what a source looks like that is not of the given format."""
    found = detect(source)
    return f"; it looks like {found.title}" if found not in (None, known) else ""


@contextmanager
def _broken(source: Source, description: Callable[[], str]) -> Iterator[None]:
    """Turn whatever a broken file makes its reader raise into a `FormatError`."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is no keypoint
            yield
    except FormatError:
        raise
    except MemoryError as error:
        raise FormatError("needs more memory than there is; part it", place=source) from error
    except Exception as error:
        raise FormatError(
            f"{description()} ({type(error).__name__}: {error})", place=source
        ) from error


def find(source: Source, name: str | None) -> Format:
    """Return the given format, or that of the source.

    Raises
    ------
    FormatError
        If there is no such format, or the source has none; the message has what it looks like.
    """
    if name is None:
        found = detect(source)
        if found is None:
            with _broken(source, lambda: "a broken file"):
                raise unknown(source, {each.title: each.words for each in FORMATS if each.words})
        return found
    for each in FORMATS:
        if each.name == name:
            return each
    raise FormatError(f"there is no format {name!r}; there are {', '.join(NAMES)}", option="format")
