"""Sizes and rates of cameras, from the headers of videos that lie beside the files.

No image is decoded. It needs `pip install 'fewview[video]'`; without it, nothing is looked for.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from fewview.readers.headers import plain
from fewview.readers.sources import Source
from fewview.readers.views import View

ENDINGS = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".mpg", ".mpeg", ".webm", ".wmv", ".mts")
MOST = 1000  # files of a folder that are looked at
UPRIGHT = (90.0, 270.0)  # degrees by which players turn what is stored


def with_video(view: View, source: Source) -> View:
    """Return a view with the image size and the rate of its camera's video, where it has none.

    The video has the name of the view, or one that the name of the view's file begins with, and
    lies in the folder of the file or the one above.
    """
    if view.image_size is not None and (view.fps or view.times is not None):
        return view
    video = _beside(source, view.name)
    header = None if video is None else _header(video)
    if video is None or header is None:
        return view
    width, height, rate = header
    note = f"{video.name} lies beside: {width} x {height}"
    changed = replace(view, image_size=view.image_size or (width, height))
    if rate and not view.fps and view.times is None:
        changed = replace(changed, fps=rate)
        note += f", {rate:g} frames per second"
    return replace(changed, notes=(*view.notes, note))


def _beside(source: Source, name: str) -> Path | None:
    """Return the video of a source: of those whose names it begins with, the longest."""
    folder = source.path if source.frames else source.path.parent
    called = {plain(name), plain(source.path.name), plain(source.name)}
    for place in (folder, folder.parent):
        files = [path for path, _ in zip(place.iterdir(), range(MOST), strict=False)]
        videos = [path for path in files if path.suffix.lower() in ENDINGS and plain(path.stem)]
        mine = [path for path in videos if any(one.startswith(plain(path.stem)) for one in called)]
        if mine:
            return max(mine, key=lambda path: len(path.stem))
    return None


def _header(video: Path) -> tuple[int, int, float | None] | None:
    """Return width, height and frames per second; None if they cannot be known."""
    try:
        from pymediainfo import MediaInfo  # noqa: PLC0415 (an extra)
    except ImportError:
        return None
    try:
        tracks: list[Any] = MediaInfo.parse(str(video)).video_tracks
    except (OSError, RuntimeError, ValueError):
        return None
    for track in tracks:
        if track.width and track.height:
            size = int(track.width), int(track.height)
            turned = track.rotation and float(track.rotation) % 360 in UPRIGHT
            width, height = size[::-1] if turned else size
            return width, height, float(track.frame_rate) if track.frame_rate else None
    return None
