"""From paths to a capture."""

from collections import Counter
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from fewview.capture import Capture, Float32, located
from fewview.errors import FormatError
from fewview.readers.archives import workplace
from fewview.readers.calibrations import calibrations_at, calibrations_within, of_views
from fewview.readers.combining import cleaned, combined, named
from fewview.readers.file_names import distinct_parts
from fewview.readers.finding import AnyPath, paths_at, sources_at
from fewview.readers.large_arrays import blocks
from fewview.readers.people import pick
from fewview.readers.registry import views_of
from fewview.readers.sides import counted_from, doubts_of_sides, put_right
from fewview.readers.thumbnails import people_of
from fewview.readers.timing import put_in_step, with_rates
from fewview.readers.union import with_all_keypoints
from fewview.readers.videos import with_video
from fewview.readers.views import View, unseen
from fewview.readers.views_in_names import with_mirrors, with_views_in_names
from fewview.readers.vision import turned_down
from fewview.reading_options import Align, Person, ReadingOptions, Size, Sizes

SHARES = 3.0  # most pixels lie further out than this many images
MIDDLE = 0.25  # where shares from the middle of the image have their median, and go beyond


def read(
    paths: AnyPath | Iterable[AnyPath],
    *,
    format: str | None = None,
    person: Person | Sequence[Person] = "auto",
    min_confidence: float = 0.0,
    skeleton: str | None = None,
    align: Align = "auto",
    fps: float | str | None = None,
    image_size: Sizes | None = None,
    untrusted: bool = False,
    columns: str | None = None,
    cameras: Sequence[str] | str | None = None,
    trial: str | None = None,
    y: Literal["down", "up"] = "down",
    mirror: Sequence[str] | str | None = None,
    offset: str | None = None,
    offset_seconds: str | None = None,
    views_in_names: Sequence[str] | str | None = None,
) -> Capture:
    """Read the 2D keypoints of all cameras.

    Parameters
    ----------
    paths
        A file, a folder, or a file or folder for each camera; a zip file is read as a folder.
    format
        Name of the format (`fewview.readers.registry.NAMES`); None to find it from the content.
    person
        Of several people or animals: "auto" for the one that is seen most; a number for a place
        among those with names, else for a rank, 0 for the one that is seen most; a name for a track
        or individual; a list or "0,1,0" for each camera separately.
    min_confidence
        Detections with less confidence are gaps.
    skeleton
        Name of a skeleton (`fewview.readers.skeletons.SKELETONS`) with the names and edges of the
        keypoints; None: from the file, or from the number of keypoints.
    align
        "index": frames of the same number belong together. "time": frames of the nearest time.
        "auto": by time if the cameras' rates or times differ.
    fps
        Frames per second, if a file has no times: of all, or "cam1=60,cam2=30".
    image_size
        (width, height) in pixels of all views, of each, or a mapping by their names; "1920x1080"
        for all, "1920x1080,cam2=1080x1920" where some differ.
    untrusted
        Whether the files are untrusted: formats whose readers have to trust their files (C3D,
        pickles) are then refused. Files may still need much memory and time.
    columns
        The contents of a table's columns, if their names are unusual: "x={}_x,y={}_y,frame=No",
        with {} for the keypoint's name, {camera} and {person} for theirs.
    cameras
        Names of the views that are wanted, in their order.
    trial
        Name of the trial, or of the detector, to read, if there are files of several.
    y
        "up" if y counts from the lower edge of the image.
    mirror
        Names of the views whose images are mirrored, left and right; None: of those whose names
        have a mirror in them, "none" if none is.
    offset
        Where in the whole image the corner lies from which a view's keypoints count, if they were
        found in a crop: "cam2=560,180", or "560,180" of all.
    offset_seconds
        By how much views show every moment later than the others: "cam2=4.2", negative if earlier.
        Frames are then joined by times, so files without times need `fps`.
    views_in_names
        Words of the cameras that keypoints' names begin or end with: "real,mirror"; None to find
        them, "none" if there are none.

    Returns
    -------
    Capture
        Its `notes` report how the files were read, and what was left out and changed.

    Raises
    ------
    FormatError
        If a file is of no known format, or the files do not fit together; the message has what
        it looks like and a remedy.
    """
    options = ReadingOptions(
        format=format,
        person=person,
        min_confidence=min_confidence,
        skeleton=skeleton,
        align=align,
        fps=fps,
        image_size=image_size,
        untrusted=untrusted,
        columns=columns,
        cameras=cameras,
        trial=trial,
        y=y,
        mirror=mirror,
        offset=offset,
        offset_seconds=offset_seconds,
        views_in_names=views_in_names,
    )
    return read_with(paths, options)


def read_with(
    paths: AnyPath | Iterable[AnyPath],
    options: ReadingOptions,
    calibrated_sizes: Callable[[Sequence[str]], Sequence[Size | None]] | None = None,
    *,
    with_people: bool = False,
) -> Capture:
    """Read the 2D keypoints of all cameras, as `read` does.

    Parameters
    ----------
    options
        As `read` takes them.
    calibrated_sizes
        Gives the image sizes of a calibration for the names of the views. They are those of views
        whose size is neither given nor in their file, instead of those of a calibration that lies
        among the files.
    with_people
        Whether to look whom each view shows (`Capture.people`).
    """
    notes: list[str] = []
    with workplace() as folder:
        given = paths_at(paths, folder)
        beside = calibrations_at(given, notes)
        views, one_file = _views_at(given, beside.paths, options, notes)
    views = with_views_in_names(views, options.words_of_views)
    if options.y == "down":
        views = list(map(turned_down, views))
    names = distinct_parts([view.name for view in views])
    views = [replace(view, name=name) for view, name in zip(views, names, strict=True)]
    views = with_mirrors(views) if options.mirror is None else views
    beside = calibrations_within(beside, views)
    wanted = options.named("cameras", names)
    known, calibration = of_views(beside, names, wanted, notes)
    views = views if wanted is None else [views[index] for index in wanted]
    names = tuple(view.name for view in views)
    usual: Sequence[Size | None] = [camera.size for camera in known or ()] or [None] * len(names)
    usual = calibrated_sizes(names) if calibrated_sizes else usual
    views = _sized(with_rates(views, options.rates(names)), options.sizes(names), usual, notes)
    clean: list[View] = []
    for view in views:
        one, more = cleaned(view, options.min_confidence)
        clean.append(one)
        notes += more
    clean = counted_from(clean, options.corners(names), notes)
    delays, align = options.delays(names), options.align
    if any(delays):
        clean = put_in_step(clean, delays, notes)
        align = "time" if align == "auto" else align
    clean = with_all_keypoints(clean, notes)
    picked, more = pick(clean, options.person)
    called = named(picked, options.skeleton, more)
    people = people_of(clean, picked, called, options.y) if with_people else None
    mirrored = options.named("mirror", names)
    if mirrored is None:
        mirrored = [index for index, view in enumerate(called) if view.mirrored]
    picked = put_right(called, options.y, mirrored, more)
    capture = combined(picked, align=align, one_file=one_file)
    return replace(
        capture,
        notes=(*notes, *more, *capture.notes, *doubts_of_sides(capture)),
        calibration=calibration,
        people=people,
    )


def _views_at(
    paths: Sequence[Path], others: Container[Path], options: ReadingOptions, notes: list[str]
) -> tuple[list[View], bool]:
    """Return the views of all files, and whether they are of one file; note what it was read as."""
    views: list[View] = []
    kinds: Counter[str] = Counter()
    format = options.format or ("csv" if options.columns else None)
    sources = sources_at(paths, format, notes, others=others, trial=options.trial)
    for source, kind in sources:
        found = views_of(source, kind, untrusted=options.untrusted, columns=options.columns)
        if len(found) == 1 and not options.untrusted:
            found = [with_video(found[0], source)]
        views += found
        kinds[kind.title] += len(found)
    titles = ", ".join(f"{title} ({count} cameras)" for title, count in kinds.items())
    notes.insert(0, f"read as {titles}" if len(kinds) > 1 else f"read as {next(iter(kinds))}")
    return views, len(sources) == 1


def _sized(
    views: list[View], given: list[Size | None], usual: Sequence[Size | None], notes: list[str]
) -> list[View]:
    """Return the views with their image sizes, and with coordinates in pixels.

    Sizes are those that were given, else those of the files, else the usual ones, of a calibration.

    Raises
    ------
    FormatError
        If coordinates are shares of images whose size is not known.
    """
    own = [size or view.image_size for view, size in zip(views, given, strict=True)]
    sizes = [size or other for size, other in zip(own, usual, strict=True)]
    for view, size, other in zip(views, sizes, usual, strict=True):
        if size and other and size != other:
            notes.append(
                f"{view.name}: its images are {size[0]}x{size[1]}, those of the calibration "
                f"{other[0]}x{other[1]}: its lens may not fit them"
            )
    shares = [_are_shares(view) for view in views]
    unknown = [
        view.name
        for view, size, share in zip(views, sizes, shares, strict=True)
        if share and size is None
    ]
    if unknown:
        raise FormatError(
            "coordinates are shares of the image's width and height, and its size is not in the "
            "file",
            place=", ".join(unknown),
            option="image_size",
            remedy=",".join(f"{name}=WIDTHxHEIGHT" for name in unknown),
        )
    out = []
    for view, size, share in zip(views, sizes, shares, strict=True):
        keypoints = view.keypoints
        if share:
            keypoints = np.require(keypoints, requirements="W")
            for block in blocks(keypoints):
                keypoints[block] *= np.array(size, np.float32)
        out.append(replace(view, keypoints=keypoints, image_size=size))
    return out


def _are_shares(view: View) -> bool:
    """Whether coordinates are shares of the image's width and height: most lie within few images.

    Some shares lie further out, of points that a detector guesses far outside of the image.

    Raises
    ------
    FormatError
        If they are counted from the middle of the image, as OpenPose can.
    """
    if view.pixels_from_zero:
        return False
    least, count, far = np.inf, 0, 0
    for block in blocks(view.keypoints):
        there = _there(view.keypoints[block])
        count += there.size
        far += int((np.abs(there) > SHARES).sum())
        if 2 * far >= view.keypoints.size:
            return False  # whatever follows
        least = min(least, float(there.min(initial=np.inf)))
    if not count or 2 * far >= count:
        return False
    if least < -MIDDLE and np.median(_there(view.keypoints)) < MIDDLE:
        raise FormatError(
            "coordinates lie between -1 and 1, which are no pixels: write pixels "
            "(OpenPose: --keypoint_scale 0)",
            place=view.name,
        )
    return True


def _there(keypoints: Float32) -> Float32:
    """Return the keypoints (F, 2) that were found, of any (..., 2)."""
    found: Float32 = keypoints[~unseen(keypoints) & located(keypoints)]
    return found
