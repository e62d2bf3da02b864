"""``fewview report``: what a fit may be relied on for, to how much, and what would help most."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fewview.commands.talking import AsJson, Url, say, table, talking

if TYPE_CHECKING:
    from fewview.api.report_forms import FitReport

MOST = 10  # rows of a table
TEN, WHOLE = 10.0, 100.0  # percent


def report(
    fit: Annotated[str, typer.Argument(help="Its id: fit_...")],
    *,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Write the report: a page of HTML, or with --json all of it."
        ),
    ] = None,
    url: Url = None,
    as_json: AsJson = False,
) -> None:
    """Print what a fit may be relied on for, or write a report to save and print."""
    with talking(url) as client:
        found = client.fits.report(fit)
        if output is None:
            say(found.raw, in_words(found), as_json=as_json)
            return
        text = json.dumps(found.raw) if as_json else client.fits.report_page(fit)
        part = output.with_name(f"{output.name}.part")
        part.write_text(text, encoding="utf-8")
        part.replace(output)
        say({"file": str(output)}, f"wrote {output}", as_json=as_json)


def in_words(found: "FitReport") -> str:
    """Return the report as lines for people."""
    verdict = found.verdict
    lines = [f"{verdict.level}: {verdict.reliable} {verdict.remedy}".strip()]
    lines += [verdict.expected] if verdict.expected else []
    names = found.keypoint_names or [f"keypoint {n}" for n in range(len(found.of_keypoints))]
    known = [
        (error, name)
        for error, name in zip(found.of_keypoints, names, strict=True)
        if error is not None
    ]
    if known:
        known.sort(key=lambda item: -item[0])
        rows = [("keypoint", "expected error")]
        rows += [(name, _length(error, found)) for error, name in known[:MOST]]
        lines += ["", table(rows)]
    if found.of_views:
        rows = [("views", "expected error")]
        rows += [
            (_views(some.views, found), _length(some.expected_error, found))
            for some in found.of_views[:MOST]
        ]
        lines += ["", table(rows)]
    lines += ["", f"fewview report {found.fit_id} -o report.html writes all of it as a page"]
    return "\n".join(lines)


def _views(views: tuple[int, ...], found: "FitReport") -> str:
    names = found.view_names
    return ", ".join(str(view) if names is None else names[view] for view in views)


def _length(error: float | None, found: "FitReport") -> str:
    """Return a length as a share of the subject's height, and in its unit if it has one."""
    if error is None or not found.size:
        return "-"
    percent = 100 * error / found.size
    share = f"{percent:.{0 if percent >= TEN else 1}f} %" if percent <= WHOLE else "over 100 %"
    return share if found.unit is None else f"{error:.3g} ({share})"
