"""TRC, the markers that OpenSim reads.

Five lines of header, an empty one, then a line for each frame, all between tabs; frames have the
numbers of the files, or count from 1. A missing point is `nan` three times: OpenSim takes no notice
of empty fields at the end of a line, and refuses a line that has fewer. It refuses one that has
more, too, so there is no place for how far points may be off. The header names the unit, so it must
be known.

Source: OpenSim documentation, "Marker (.trc) Files".
"""

from pathlib import Path

from fewview.animation import Animation
from fewview.errors import FormatError
from fewview.writers.numbers import text, texts, time_text


def write(path: Path, animation: Animation) -> None:
    """Write an animation as markers.

    Raises
    ------
    FormatError
        If the unit is unknown, or a name has a tab or a line break.
    """
    if animation.unit is None:
        raise FormatError(
            "TRC names the unit of its points, which is unknown where a fit is given no length, no "
            "distance of cameras and no calibration",
            option="unit",
            remedy="m",
        )
    if any(character in name for name in animation.names for character in "\t\r\n"):
        raise FormatError("names in TRC stand between tabs: they can have no tab or line break")
    frames, count = animation.points.shape[:2]
    rate = text(animation.rate)
    header = ("DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate")
    numbers = animation.frames
    first = 1 if animation.numbers is None else 0  # added to what counts from 0
    start = first + (numbers[0] if numbers else 0)
    values = (rate, rate, frames, count, animation.unit, rate, start, frames)
    axes = [f"{axis}{place + 1}" for place in range(count) for axis in "XYZ"]
    lines = [
        ["PathFileType", "4", "(X/Y/Z)", path.name],
        [*header, "OrigDataStartFrame", "OrigNumFrames"],
        [str(value) for value in values],
        ["Frame#", "Time", *(part for name in animation.names for part in (name, "", ""))],
        ["", "", *axes],
        [],
    ]
    for frame, time, points in zip(numbers, animation.seconds, animation.points, strict=True):
        fields = [field or "nan" for field in texts(points)]
        lines.append([str(frame + first), time_text(time), *fields])
    written = "".join("\t".join(line) + "\n" for line in lines)
    path.write_text(written, encoding="utf-8", newline="\n")
