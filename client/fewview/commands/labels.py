"""``fewview labels``: which images to label, and what a fit accepts as labels of a detector."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fewview.commands.progress import FitProgressBar
from fewview.commands.talking import AsJson, Url, finite, say, table, talking

if TYPE_CHECKING:
    from fewview.api.label_forms import ImageWorthLabelling

HEADING = ("view", "frame", "score", "why")
LISTED = 500  # images at most
NOTHING = "no image stands out as worth labelling; `--all` writes all images that have labels"
SHOWN = 8  # keypoints of a reason that are named


def labels(
    fit: Annotated[str, typer.Argument(help="Its id: fit_...")],
    *,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The folder to write files of labels into."),
    ] = None,
    form: Annotated[
        Literal["dlc", "dlc-machine", "coco", "lightning-pose"],
        typer.Option("--format", help="Of the files."),
    ] = "dlc",
    most: Annotated[
        int | None, typer.Option(min=1, help="How many images at most; with `--all` of each view.")
    ] = None,
    every: Annotated[
        bool, typer.Option("--all", help="Write all images that have labels, not only those.")
    ] = False,
    source: Annotated[
        Literal["reprojections", "keypoints"],
        typer.Option(help="Where the fit shows keypoints, or those detected that it agrees with."),
    ] = "reprojections",
    least_weight: Annotated[
        float,
        typer.Option(min=0, max=1, callback=finite, help="Labels of less weight are left out."),
    ] = 0.0,
    scorer: Annotated[str, typer.Option(help="As in the project of DeepLabCut.")] = "fewview",
    url: Url = None,
    as_json: AsJson = False,
) -> None:
    """List the images that would teach the detector most; write what the fit accepts as labels."""
    with talking(url) as client:
        with FitProgressBar(quiet=as_json) as bar:
            done = client.fits.wait(fit, on_progress=bar.show)
        limit = None if every or most is None else min(most, LISTED)
        found = client.fits.labels(done, limit=limit)
        result = found.raw | {"files": []}
        corrected = client.datasets.get(done.dataset_id).corrections.count
        if output is not None and (every or found.images or corrected):
            files = client.fits.download_labels(
                done,
                output,
                form,
                source=source,
                images="all" if every else "worth-labelling",
                most=most,
                least_weight=least_weight,
                scorer=scorer,
            )
            result["files"] = [str(file) for file in files]
        skeleton = client.models.get(str(done.model_id)).skeleton or {}
        names = skeleton.get("keypoint_names")
        say(result, in_words(found.images, names, result), as_json=as_json)


def in_words(
    images: Sequence["ImageWorthLabelling"], names: Sequence[str] | None, result: dict[str, Any]
) -> str:
    """Return the images and the files as lines for people."""
    rows = [
        (image.view_name, str(image.frame), f"{image.score:.2f}", _why(image, names))
        for image in images
    ]
    lines = [table([HEADING, *rows])] if rows else [NOTHING]
    if result["candidates"] > len(rows):
        lines.append(f"{result['candidates']} images are worth it, with those that are like these")
    return "\n".join([*lines, *(f"wrote      {file}" for file in result["files"])])


def _why(image: "ImageWorthLabelling", names: Sequence[str] | None) -> str:
    """Return the reasons of an image, with the keypoints and how far they are off."""
    parts = []
    for reason in image.reasons:
        called = [names[place] if names else f"point{place + 1}" for place in reason.keypoints]
        listed = ", ".join(called[:SHOWN]) + (", ..." if len(called) > SHOWN else "")
        error = reason.evidence.get("error_px")
        off = "" if error is None else f" ({error:.0f} px)"
        parts.append(f"{reason.code.replace('_', ' ')} {listed}".rstrip() + off)
    return "; ".join(parts)
