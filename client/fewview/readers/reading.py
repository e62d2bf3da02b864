"""From paths to a capture."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from fewview.capture import Capture
from fewview.errors import FormatError
from fewview.readers.archives import workplace
from fewview.readers.combining import cleaned, combined
from fewview.readers.finding import AnyPath, sources_at
from fewview.readers.names import told_apart
from fewview.readers.people import pick
from fewview.readers.registry import views_of
from fewview.readers.views import View
from fewview.reading_options import Align, Person, ReadingOptions, Size

SHARES = 3.0  # pixels go further than this many images
MIDDLE = 0.25  # where shares from the middle of the image have their median, and go beyond


def read(
    paths: AnyPath | Iterable[AnyPath],
    *,
    format: str | None = None,
    person: Person | Sequence[Person] = "auto",
    min_confidence: float = 0.0,
    skeleton: str | None = None,
    align: Align = "index",
    fps: float | None = None,
    image_size: Size | Sequence[Size] | str | None = None,
    untrusted: bool = False,
) -> Capture:
    """Read the 2D keypoints of all cameras.

    Parameters
    ----------
    paths
        A file, a folder, or a file or folder for each camera; a zip file stands for a folder.
    format
        Name of the format (`fewview.readers.registry.NAMES`); None to find out from the content.
    person
        Of several people or animals: "auto" for the one that is seen most; a number for a place
        among those with names, else for a rank, 0 for who is seen most; a name for a track or
        individual; a list or "0,1,0" for each camera on its own.
    min_confidence
        Detections that are less sure are gaps.
    skeleton
        Name of a skeleton (`fewview.readers.skeletons.SKELETONS`) that gives the keypoints their
        names and edges; None for what the file says, or its count of keypoints.
    align
        "index": frames of the same number belong together. "time": frames of the nearest time.
    fps
        Frames per second, where a file tells no times.
    image_size
        (width, height) in pixels of all views, or of each; "1920x1080" for all.
    untrusted
        Whether the files come from somebody else: formats whose readers have to trust their files
        (C3D, pickles) are then refused. Files may still ask for much memory and time.

    Returns
    -------
    Capture
        Its `notes` say what was understood, left out and changed.

    Raises
    ------
    FormatError
        If a file is of no known format, or the files do not fit together; the message says what
        it looks like and what to do.
    """
    return read_with(
        paths,
        ReadingOptions(format, person, min_confidence, skeleton, align, fps, image_size, untrusted),
    )


def read_with(paths: AnyPath | Iterable[AnyPath], options: ReadingOptions) -> Capture:
    """Read the 2D keypoints of all cameras, as `read` does."""
    notes: list[str] = []
    views: list[View] = []
    kinds: Counter[str] = Counter()
    with workplace() as folder:
        for source, kind in sources_at(paths, options.format, notes, folder):
            found = views_of(source, kind, untrusted=options.untrusted)
            views += found
            kinds[kind.title] += len(found)
    titles = ", ".join(f"{title} ({count} cameras)" for title, count in kinds.items())
    notes.insert(0, f"read as {titles}" if len(kinds) > 1 else f"read as {next(iter(kinds))}")
    names = told_apart([view.name for view in views])
    views = [replace(view, name=name) for view, name in zip(views, names, strict=True)]
    views = _sized(views, options.sizes())
    clean: list[View] = []
    for view in views:
        one, said = cleaned(view, options.min_confidence)
        clean.append(one)
        notes += said
    picked, said = pick(clean, options.person)
    capture = combined(picked, align=options.align, fps=options.fps, skeleton=options.skeleton)
    return replace(capture, notes=(*notes, *said, *capture.notes))


def _sized(views: list[View], asked: Size | Sequence[Size] | None) -> list[View]:
    """Return the views with the image sizes that were told, and with coordinates in pixels."""
    sizes: list[Size | None] = [view.image_size for view in views]
    if asked is not None:
        told = np.array(asked)
        if told.shape not in ((2,), (len(views), 2)) or not (told > 0).all():
            raise FormatError(
                f"image_size is {asked!r}, not (width, height), nor {len(views)} of these"
            )
        sizes = [(int(w), int(h)) for w, h in np.broadcast_to(told, (len(views), 2))]
    out = []
    for view, size in zip(views, sizes, strict=True):
        keypoints = view.keypoints
        if _are_shares(view):
            if size is None:
                raise FormatError(
                    f"{view.name}: coordinates are shares of the image's width and height, and its "
                    "size is not in the file; say image_size=(width, height), or --image-size "
                    "WIDTHxHEIGHT"
                )
            keypoints = keypoints * np.array(size, np.float32)
        out.append(replace(view, keypoints=keypoints, image_size=size))
    return out


def _are_shares(view: View) -> bool:
    """Whether coordinates are shares of the image's width and height: all lie within few images.

    Raises
    ------
    FormatError
        If they are counted from the middle of the image, as OpenPose can.
    """
    far = (view.keypoints > SHARES) & (view.keypoints < np.inf)
    if view.pixels_from_zero or far.any():
        return False
    nowhere = (view.keypoints == 0).all(-1) | (view.keypoints == -1).all(-1)
    there = view.keypoints[~nowhere & np.isfinite(view.keypoints).all(-1)]
    if not len(there) or there.min() < -SHARES:
        return False
    if np.median(there) < MIDDLE and there.min() < -MIDDLE:
        raise FormatError(
            f"{view.name}: coordinates lie between -1 and 1, which are no pixels: write pixels "
            "(OpenPose: --keypoint_scale 0)"
        )
    return True
