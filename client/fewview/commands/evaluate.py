"""``fewview evaluate``: structures against a ground truth."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fewview.commands.talking import WRONGLY_ASKED, AsJson, echo, finite, in_short, say, table

if TYPE_CHECKING:
    from fewview.evaluation import Evaluation

NAMES = ("points", "points3d")  # of the array in a file
WORST = 5  # keypoints that are listed


def evaluate(
    found: Annotated[
        Path,
        typer.Argument(
            help="npz or safetensors with `points` or `points3d` (N, P, 3); else a calibration."
        ),
    ],
    truth: Annotated[Path | None, typer.Argument(help="The same of the truth.")] = None,
    *,
    cameras: Annotated[
        Path | None, typer.Option(help="Compare the cameras in FOUND with this calibration.")
    ] = None,
    reach: Annotated[
        float | None,
        typer.Option(
            min=1e-12, callback=finite, help="Largest threshold of PCK, in the truth's unit."
        ),
    ] = None,
    mirrored_too: Annotated[
        bool, typer.Option("--mirrored-too", help="Forgive a mirror image of all frames.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Measure structures (PA-MPJPE, MPJPE, PCK), or cameras, against a truth."""
    from fewview.errors import FewviewError  # noqa: PLC0415 (commands load what they need)

    try:
        if cameras is not None:
            figures, words = _cameras(found, cameras)
        elif truth is not None:
            figures, words = _structures(found, truth, reach, mirrored_too=mirrored_too)
        else:
            raise ValueError("name the truth: a second npz, or --cameras and a calibration")
    except (OSError, ValueError, FewviewError) as error:
        echo(f"fewview evaluate: {in_short(error)}", err=True)
        raise typer.Exit(WRONGLY_ASKED) from None
    say(figures, words, as_json=as_json)


def _structures(
    found: Path, truth: Path, reach: float | None, *, mirrored_too: bool
) -> tuple[dict[str, Any], str]:
    from fewview.evaluation import evaluate  # noqa: PLC0415

    points, names = _read(found)
    expected, others = _read(truth)
    figures = evaluate(points, expected, reach=reach, mirrored_too=mirrored_too)
    named = names or others or [str(p) for p in range(len(figures.per_keypoint))]
    return figures.plain() | {"keypoint_names": named}, in_words(figures, named)


def _cameras(found: Path, expected: Path) -> tuple[dict[str, Any], str]:
    from fewview.calibration import compare_cameras, for_views, read_cameras  # noqa: PLC0415

    cameras = read_cameras(found)
    calibration, _ = for_views(read_cameras(expected), [camera.name for camera in cameras])
    figures = [error.plain() for error in compare_cameras(cameras, calibration)]
    rows = [("camera", "rotation", "direction", "centre", "focal x, y", "principal point")]
    for one in figures:
        known = one["rotation"] is not None
        rows.append(
            (
                one["name"],
                f"{one['rotation']:.2f} deg" if known else "-",
                f"{one['direction']:.2f} deg" if known else "-",
                f"{one['centre']:.4g}" if known else "-",
                "{:+.2f} {:+.2f} %".format(*one["focal"]),
                f"{one['principal_point']:.1f} px",
            )
        )
    return {"cameras": figures}, table(rows)


def in_words(figures: "Evaluation", names: list[str]) -> str:
    """Return the figures as lines for people."""
    import numpy as np  # noqa: PLC0415

    order = np.argsort(-np.nan_to_num(figures.per_keypoint))[:WORST]
    rows = [(names[p], f"{figures.per_keypoint[p]:.4g}") for p in order]
    mirrored = ", of the mirror image" if figures.mirrored else ""
    return "\n".join(
        (
            f"frames     {figures.frames}",
            f"PA-MPJPE   {figures.pa_mpjpe:.4g}, every frame aligned alone{mirrored}",
            f"MPJPE      {figures.mpjpe:.4g}, all frames aligned together",
            f"PCK        {figures.pck[-1]:.1%} within {figures.thresholds[-1]:.4g}, "
            f"area under the curve {figures.auc:.3f}",
            "worst keypoints",
            table(rows),
        )
    )


def _read(path: Path) -> tuple[Any, list[str] | None]:
    """Return the structures in a file, and the names of their keypoints, if it has them.

    Raises
    ------
    ValueError
        If it is no npz or safetensors with structures.
    """
    arrays, keypoint_names = _arrays(path)
    for name in NAMES:
        if name in arrays:
            return arrays[name], keypoint_names
    raise ValueError(f"{path}: expected an array `points` or `points3d`, it has {list(arrays)}")


def _arrays(path: Path) -> tuple[dict[str, Any], list[str] | None]:
    """Return the arrays in a file, and the names of its keypoints."""
    import zipfile  # noqa: PLC0415

    import numpy as np  # noqa: PLC0415

    from fewview.api.arrays import read_safetensors  # noqa: PLC0415

    if path.suffix.lower() == ".safetensors":
        try:
            arrays, about = read_safetensors(path.read_bytes())
            return arrays, json.loads(about.get("keypoint_names", "null"))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"{path}: no safetensors file ({error})") from error
    if not zipfile.is_zipfile(path):
        path.stat()  # raises the error for a missing file
        raise ValueError(f"{path}: expected an .npz or .safetensors file")
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)
    names = arrays.get("keypoint_names")
    return arrays, None if names is None else names.tolist()
