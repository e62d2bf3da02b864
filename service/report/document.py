"""The report on a fit as a page of HTML. Names in it are of users: all are escaped."""

from base64 import b64encode
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from service.report import charts
from service.wire.reports import FitReport

FOLDER = Path(__file__).parent
STYLE = (FOLDER / "report.css").read_text()
STYLE_SOURCE = f"'sha256-{b64encode(sha256(STYLE.encode()).digest()).decode()}'"
# It is in the page, too, where it holds when this is saved.
LOADS = f"default-src 'none'; style-src {STYLE_SOURCE}; base-uri 'none'; form-action 'none'"
POLICY = f"{LOADS}; frame-ancestors 'none'"
UNKNOWN = "\N{EN DASH}"
MOST_RUNS = 50  # of doubtful frames that are listed
UNITS = {
    "known_length": "the unit of the known length",
    "known_distance": "the unit of the known distance",
    "calibration": "the unit of the calibration",
}
REASONS = {
    "little_evidence": "few keypoints or views show the subject",
    "views_disagree": "the views do not agree",
    "unlike_fit": "the structure is unlike those of the fit",
    "no_evidence": "there is no structure",
}
LEVELS = {"good": "Good", "caution": "With limits", "serious": "With serious doubts"}

_templates = Environment(
    loader=FileSystemLoader(FOLDER),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def document_of(report: FitReport) -> str:
    """Return the report as HTML."""
    noise = report.noise_px or []
    views = len(noise) or max((len(frame.views) for frame in report.drawn), default=0)
    if report.found_cameras is not None:
        views = len(report.found_cameras.views) or views
    view_names = report.view_names or [f"view {view}" for view in range(views)]
    names = report.keypoint_names or [f"keypoint {n}" for n in range(len(report.of_keypoints))]
    return _templates.get_template("report.html").render(
        report=report,
        style=STYLE,
        policy=LOADS,
        made=datetime.now(UTC),
        unit=None if report.unit is None else UNITS[report.unit],
        reasons=REASONS,
        level=LEVELS[report.verdict.level],
        length=lengths_of(report),
        share=shares_of(report),
        number=number,
        percent=percent,
        keypoints=charts.bars(names, report.of_keypoints),
        errors=charts.curve(report.of_frames, report.reasons),
        qualities=charts.curve(_lowest(report.quality), report.reasons, 1.0),
        doubtful=charts.doubtful(report),
        most_runs=MOST_RUNS,
        noise=charts.heat([list(row) for row in zip(*noise, strict=True)]),
        names=names,
        view_names=view_names,
        frames=_frames(report),
        worth=charts.worth(report, view_names),
        sectors=charts.sectors(report),
        on_map=charts.on_map,
        wide=charts.WIDE,
        high=charts.HIGH,
    )


def _lowest(values: Sequence[float | None]) -> list[float | None]:
    """Return the least of the values that share a place of a curve, for each of them."""
    step = max(1, -(-len(values) // charts.WIDE))
    found: list[float | None] = []
    for start in range(0, len(values), step):
        part = values[start : start + step]
        known = [value for value in part if value is not None]
        found += [min(known, default=None)] * len(part)
    return found


def _frames(report: FitReport) -> list[tuple[int, list[charts.Drawn | None]]]:
    edges = report.edges or []
    return [
        (frame.frame, [charts.drawn(view.detected, view.answered, edges) for view in frame.views])
        for frame in report.drawn
    ]


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with so many digits, as people write it."""
    if value is None:
        return UNKNOWN
    if abs(value) >= 10**digits:
        return f"{value:.0f}"
    return f"{value:.{digits}g}"


def percent(share: float | None) -> str:
    """Return a share with two digits; beyond the whole nothing is known."""
    if share is None:
        return UNKNOWN
    if share > 1:
        return "over 100 %"
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def shares_of(report: FitReport) -> Callable[[float | None], str]:
    """Return what words a length as a share of the subject's height."""
    size = report.size
    return lambda value: percent(None if value is None or not size else value / size)


def lengths_of(report: FitReport) -> Callable[[float | None], str]:
    """Return what words a length: in its unit if it has one, else as a share."""
    share = shares_of(report)
    if report.unit is None:
        return share
    return lambda value: UNKNOWN if value is None else f"{number(value)} ({share(value)})"
