"""``fewview convert``: files of any known format, as one npz of all cameras."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from fewview.commands.reading import Files, Options, reading_files
from fewview.commands.talking import AsJson, echo, in_short

if TYPE_CHECKING:
    from fewview.capture import Capture


@reading_files
def convert(
    options: Options,
    files: Files,
    *,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="The npz to write; without it, only look.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Read 2D keypoints of any known format, print how they were read, and write one npz."""
    from fewview.errors import FormatError  # noqa: PLC0415 (commands load what they need)
    from fewview.readers import read_with  # noqa: PLC0415

    if output is not None and output.suffix != ".npz":
        _refuse(f"{output}: an npz is written; name it {output.with_suffix('.npz').name}")
    try:
        capture = read_with(files, options())
    except (FormatError, OSError) as error:
        _refuse(in_short(error))
    understood = summary(capture)
    echo(json.dumps(understood) if as_json else in_words(understood))
    if output is not None:
        try:
            _write(capture, output)
        except OSError as error:
            _refuse(f"{output}: {error.strerror or error}")
        if not as_json:
            echo(f"wrote {output}")


def summary(capture: "Capture") -> dict[str, Any]:
    """Return what was understood of files, as it goes into JSON.

    Returns
    -------
    dict
        ``frames``, ``frame_numbers`` (first and last, None where they count from 0), ``keypoints``
        (a count), ``keypoint_names``, ``edges``, ``fps``, ``times`` (seconds from first to last,
        None without), ``cameras`` with ``name``, ``image_size`` and ``gaps`` (the share of
        keypoints that it does not show), and ``notes``.
    """
    from fewview.readers.large_arrays import blocks  # noqa: PLC0415

    seen = [0] * capture.views
    for block in blocks(capture.keypoints, capture.confidence):
        seen += capture.observed_in(block).sum(axis=(0, 2))
    most = max(1, capture.frames * capture.keypoints.shape[2])
    names = capture.view_names or tuple(f"view {v + 1}" for v in range(capture.views))
    sizes = capture.image_sizes or (None,) * capture.views
    times = capture.times
    numbers = None if capture.numbers is None else capture.numbers.tolist()
    return {
        "frames": capture.frames,
        "frame_numbers": numbers and [numbers[0], numbers[-1]],
        "keypoints": int(capture.keypoints.shape[2]),
        "keypoint_names": capture.keypoint_names and list(capture.keypoint_names),
        "edges": capture.edges and [list(edge) for edge in capture.edges],
        "fps": capture.fps,
        "times": None if times is None else [float(times.min()), float(times.max())],
        "cameras": [
            {
                "name": name,
                "image_size": size and list(size),
                "gaps": round(1 - float(count) / most, 4),
            }
            for name, size, count in zip(names, sizes, seen, strict=True)
        ],
        "notes": list(capture.notes),
    }


def in_words(understood: dict[str, Any]) -> str:
    """Return the summary as lines for people."""
    cameras, names = understood["cameras"], understood["keypoint_names"]
    listed = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "") if names else "no names"
    numbers = understood["frame_numbers"]
    numbered = f", numbered {numbers[0]} to {numbers[1]}" if numbers else ""
    lines = [
        f"cameras    {len(cameras)}",
        f"frames     {understood['frames']}{numbered}",
        f"keypoints  {understood['keypoints']} ({listed}), {len(understood['edges'] or ())} edges",
    ]
    if understood["fps"]:
        lines.append(f"fps        {understood['fps']:g}")
    if understood["times"]:
        first, last = understood["times"]
        lines.append(f"times      {first:.3f} to {last:.3f} s")
    width = max(len(camera["name"]) for camera in cameras)
    for camera in cameras:
        size = camera["image_size"]
        shown = f"  {size[0]} x {size[1]}" if size else ""
        lines.append(f"  {camera['name']:<{width}}  {camera['gaps']:6.1%} gaps{shown}")
    if len(cameras) < 2:
        lines.append("one camera alone has no 3D: give a file or folder for each")
    return "\n".join([*lines, *(f"- {note}" for note in understood["notes"])])


def _write(capture: "Capture", path: Path) -> None:
    """Write the npz beside its place, then put it there: it is whole or not there."""
    from fewview.readers.large_arrays import save  # noqa: PLC0415

    part = path.with_name(f".{path.name}.part")
    try:
        save(part, capture.arrays())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _refuse(message: str) -> NoReturn:
    line = " ".join(message.split())
    echo(f"fewview convert: {line}", err=True)
    sys.exit(2)
