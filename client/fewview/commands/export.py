"""``fewview export``: what came of a fit, as files of other tools."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from fewview.commands.progress import FitProgressBar
from fewview.commands.talking import AsJson, Url, finite, say, talking
from fewview.mended import put_right

USUAL = "trc,csv,glb,npz"
LengthUnit = Annotated[
    Literal["m", "mm"] | None,
    typer.Option("--unit", help="Of the lengths, or of the calibration, given to the fit."),
]
Height = Annotated[
    float | None,
    typer.Option(
        min=1e-3,
        callback=finite,
        help="Of the body, in `--unit` or metres. The scale is then approximate.",
    ),
]
Formats = Annotated[str, typer.Option(help="Formats of the animation, by commas.")]


def export(
    fit: Annotated[str, typer.Argument(help="Its id: fit_...")],
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="The folder to write into.")],
    formats: Formats = USUAL,
    fps: Annotated[
        float | None,
        typer.Option(
            min=1e-6, max=1e5, callback=finite, help="Frames per second, if they are even."
        ),
    ] = None,
    unit: LengthUnit = None,
    height: Height = None,
    url: Url = None,
    as_json: AsJson = False,
) -> None:
    """Write a fit's animation in one room, its cameras and its model into a folder."""
    with talking(url) as client:
        from fewview.commands.running import described_by, export  # noqa: PLC0415

        chosen = formats_in(formats)
        output.mkdir(parents=True, exist_ok=True)
        with FitProgressBar(quiet=as_json) as bar:
            done = client.fits.wait(fit, on_progress=bar.show)
        capture = described_by(client, done)
        capture = replace(capture, fps=fps or capture.fps)
        check_height(height, capture.keypoint_names, done.config or {})
        result = export(
            client,
            done,
            capture,
            output,
            formats=chosen,
            unit=unit,
            height=height,
        )
        say(result, in_words(result), as_json=as_json)


def check_height(
    height: float | None, names: Sequence[str] | None, config: Mapping[str, Any]
) -> None:
    """Raise ``ValueError`` if a height cannot be used, or the fit has a better unit."""
    if height is not None:
        from fewview.height import joints_of  # noqa: PLC0415 (commands load what they need)

        joints_of(names)
        poses = [camera for camera in config.get("calibration") or () if camera]
        measured = config.get("known_length") or config.get("known_distance")
        if measured or any(camera.get("translation") for camera in poses):
            raise ValueError("--height: the fit has a known length or poses, which are better")


def formats_in(text: str) -> list[str]:
    """Return the names of formats in a text.

    Raises
    ------
    ValueError
        If there is no such format.
    """
    from fewview.writers.registry import FORMATS  # noqa: PLC0415 (commands load what they need)

    known = [known.name for known in FORMATS]
    chosen = [name.strip() for name in text.split(",") if name.strip()]
    wrong = [name for name in chosen if name not in known]
    if wrong:
        listed = ", ".join(known)
        raise ValueError(f"--formats: there is no format {wrong[0]!r}; there are: {listed}")
    return chosen


def in_words(result: dict[str, Any]) -> str:
    """Return what was written, and what was noticed, as lines for people."""
    lines = [
        f"model      {result['model'] or 'comes at the end'}",
        f"cameras    {result['arrangement']}",
        f"frames     {result['frames']}, {result['in_room']} of them in one room",
        f"error      {result['reprojection_error']:.2f} px from the keypoints, mean",
    ]
    if result.get("verdict"):
        lines.append(f"{result['verdict']['level']:<10} {result['verdict']['reliable']}")
        lines += [f"           {words}" for words in [result["verdict"]["expected"]] if words]
    for finding in result["findings"]:
        if put_right(finding):  # a note has it
            continue
        lines.append(
            f"{finding['severity']:<10} {finding['code']}{_where(finding)}: {finding['effect']}"
        )
        lines.append(f"           {finding['remedy']}")
        if finding["evidence"]:
            known = (f"{name} {value:.3g}" for name, value in finding["evidence"].items())
            lines.append(f"           {', '.join(known)}")
    lines += [f"- {note}" for note in result["notes"]]
    return "\n".join([*lines, *(f"wrote      {file}" for file in result["files"])])


def _where(finding: Mapping[str, Any]) -> str:
    """Return the cameras and frames that a finding is about, in brackets; "" for all."""
    frames = ", ".join(f"{first} to {last}" for first, last in finding["frames"][:3])
    parts = [", ".join(finding["cameras"]), f"frames {frames}" if frames else ""]
    return f" ({', '.join(filter(None, parts))})" if any(parts) else ""
