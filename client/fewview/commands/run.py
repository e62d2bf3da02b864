"""``fewview run``: from detectors' files to an animation and a calibration, with one command."""

import json
import signal
import sys
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from fewview.commands.export import (
    USUAL,
    Formats,
    Height,
    LengthUnit,
    check_height,
    formats_in,
)
from fewview.commands.export import in_words as result_in_words
from fewview.commands.fit import (
    CalibrationFile,
    KnownDistance,
    KnownLength,
    LensOption,
    MendOption,
    config_in,
    of_views,
)
from fewview.commands.reading import Files, Options, reading_files
from fewview.commands.talking import FAILED, INTERRUPTED, WRONGLY_ASKED, AsJson, echo, in_short

if TYPE_CHECKING:
    from fewview.animation import Unit
    from fewview.api.forms import Fit
    from fewview.capture import Capture


@reading_files
def run(
    options: Options,
    files: Files,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")],
    url: Annotated[
        str | None,
        typer.Option(
            envvar="FEWVIEW_URL", help="A running service; without it one is started for this."
        ),
    ] = None,
    formats: Formats = USUAL,
    known_length: KnownLength = None,
    known_distance: KnownDistance = None,
    lens: LensOption = None,
    calibration: CalibrationFile = None,
    mend: MendOption = None,
    no_calibration: Annotated[
        bool, typer.Option("--no-calibration", help="Leave a calibration among the files alone.")
    ] = False,
    unit: LengthUnit = None,
    height: Height = None,
    config: Annotated[
        list[str] | None,
        typer.Option("--config", "-c", help="Of the fit, as `fewview fit` takes it; may repeat."),
    ] = None,
    first: Annotated[
        bool,
        typer.Option(
            "--first",
            help="Write the first answer, of geometry, as soon as it is there; go on to the end, "
            "which replaces its files.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Read, upload, fit, and write animation, cameras and model; if run again, it continues."""
    from fewview.calibration import as_config, read_for_views, sizes_for  # noqa: PLC0415
    from fewview.commands.convert import in_words, summary  # noqa: PLC0415 (what it needs)
    from fewview.errors import FewviewError, InvalidRequest  # noqa: PLC0415
    from fewview.readers import read_with  # noqa: PLC0415

    try:
        sizes = None if calibration is None else partial(sizes_for, calibration)
        capture = read_with(files, options(), sizes)
        fields = config_in(config or [], known_length, mend)
        if known_length is not None:
            _check_keypoints(fields["known_length"]["keypoints"], capture)
        fields |= of_views(lens, known_distance, capture.view_names, capture.views)
        beside = None if no_calibration else capture.calibration
        if calibration is not None:
            cameras, note = read_for_views(calibration, capture.view_names, capture.views)
            fields["calibration"] = [as_config(camera) for camera in cameras]
            capture = replace(capture, notes=(*capture.notes, note))
        elif beside is not None and "calibration" not in fields:
            fields["calibration"] = list(beside.cameras)
            note = f"the fit is given the cameras of {beside.file}: {', '.join(beside.names)}"
            capture = replace(capture, notes=(*capture.notes, note))
        check_height(height, capture.keypoint_names, fields)
        chosen = formats_in(formats)
        output.mkdir(parents=True, exist_ok=True)
    except (FewviewError, ValueError, OSError) as error:
        _end(in_short(error), WRONGLY_ASKED)
    if not as_json:
        echo(in_words(summary(capture)))
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # the service is stopped then, too
    try:
        unit = unit or ("m" if known_length or known_distance else None)
        asked = capture, output, url, fields, chosen, unit, height
        done = _run(*asked, first=first, quiet=as_json)
    except (FewviewError, OSError, ValueError) as error:
        _end(in_short(error), WRONGLY_ASKED if isinstance(error, InvalidRequest) else FAILED)
    except KeyboardInterrupt:
        _end("stopped; the same command goes on where it was", INTERRUPTED)
    understood = {"understood": summary(capture)}
    echo(json.dumps(done | understood) if as_json else result_in_words(done))


def _run(
    capture: "Capture",
    folder: Path,
    url: str | None,
    config: dict[str, Any],
    formats: list[str],
    unit: "Unit | None",
    height: float | None,
    *,
    first: bool,
    quiet: bool,
) -> dict[str, Any]:
    from fewview.client import Client  # noqa: PLC0415
    from fewview.commands.moved_cameras import parted  # noqa: PLC0415
    from fewview.commands.progress import FitProgressBar  # noqa: PLC0415
    from fewview.commands.running import (  # noqa: PLC0415
        NOTES,
        NOTES_AGAIN,
        Notes,
        digest_of,
        export,
        fitted,
    )
    from fewview.embedded import running_service  # noqa: PLC0415
    from fewview.keys import token_in  # noqa: PLC0415

    data = folder / "fewview-data"
    service = running_service(data=data) if url is None else nullcontext(url)
    with ExitStack() as stack:
        address = stack.enter_context(service)
        # FEWVIEW_KEY is of another service; that of this run has its own token.
        key = None if url is not None else token_in(data) or ""
        client = stack.enter_context(Client(address, key))

        def written(fit: "Fit", capture: "Capture") -> dict[str, Any]:
            return export(client, fit, capture, folder, formats=formats, unit=unit, height=height)

        def fit_of(capture: "Capture", config: dict[str, Any], file: str) -> "Fit":
            notes = Notes.of(folder / file, digest_of(capture, config, url))
            asked: dict[str, Any] = {"name": folder.absolute().name, "config": config}

            def write_first(fit: "Fit") -> None:
                early.append(written(fit, capture))
                if not quiet:
                    echo(f"the first answer, of geometry:\n{result_in_words(early[-1])}")

            asked["on_first"] = write_first if first else None
            with FitProgressBar(quiet=quiet) as bar:
                return fitted(client, capture, notes, on_progress=bar.show, **asked)

        early: list[dict[str, Any]] = []
        fit, added = fit_of(capture, config, NOTES), []
        again = parted(capture, fit, config)
        if again is not None:
            capture, added = again.capture, [again.note]
            fit = fit_of(capture, again.config, NOTES_AGAIN)
        done = written(fit, capture)
        if first:
            done["first"] = early[-1] if early else None
        return done | {"notes": [*added, *done["notes"]]}


def _check_keypoints(pair: Sequence[int | str], capture: "Capture") -> None:
    """Raise ``ValueError`` if the capture does not have the keypoints of a known length."""
    names, count = capture.keypoint_names or (), capture.keypoints.shape[2]
    for keypoint in pair:
        if isinstance(keypoint, int) and keypoint >= count:
            raise ValueError(f"--known-length: expected keypoints 0 to {count - 1}, got {keypoint}")
        if isinstance(keypoint, str) and not names:
            raise ValueError(
                f"--known-length: the keypoints have no names, so there is no {keypoint!r}: give "
                "their skeleton with --skeleton, or use indices from 0"
            )
        if isinstance(keypoint, str) and keypoint not in names:
            near = get_close_matches(keypoint, names, n=1)
            known = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(names)}"
            raise ValueError(f"--known-length: there is no keypoint {keypoint!r}; {known}")


def _end(message: str, status: int) -> NoReturn:
    echo(f"fewview run: {message}", err=True)
    sys.exit(status)
