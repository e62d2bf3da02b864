"""What was found of drawn captures, and what shares of them hold each bar."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

SLACK = 0.001  # of the subject's height that is granted beyond a ratio
MOVING_SLACK = 0.003  # the same where cameras move
COSTLY = 0.03  # of the height: what a wrong arrangement of cameras may cost
ABOUT_CAMERAS = (  # findings that warn of the cameras
    "arrangement_not_observable",
    "cameras_not_found",
    "focal_not_observable",
    "handedness_not_observable",
    "lenses_extreme",
    "lenses_limit_accuracy",
    "views_opposite",
)


class Row(NamedTuple):
    """What was found of one draw."""

    number: int
    words: str
    error: float  # of the answer, in units of the subject's height
    bound: float  # the same of triangulation with the true cameras
    oracle: float  # the same of the oracle
    mirrored: bool  # whether the mirror image is nearer to the truth
    certainty: float  # of the handedness
    static: tuple[bool, ...]  # which cameras are, as drawn
    called_static: tuple[bool, ...]
    focal_scores: list[float]  # errors of log focal lengths over their standard deviations
    focal_error: float  # largest error of a log focal length
    turn: float  # degrees, largest error of a rotation between two cameras
    inferred: tuple[float, float]  # median and 95th percentile where one view sees, in heights
    reach: float  # longer sides of the image, largest distance of a reprojection from its centre
    findings: tuple[str, ...]
    seconds: float

    @property
    def ratio(self) -> float:
        """The error over what triangulation with the true cameras has, less the slack."""
        return max(self.error - SLACK, 0.0) / max(self.bound, 1e-9)

    @property
    def moving(self) -> bool:
        """Whether any camera moves."""
        return not all(self.static)

    @property
    def called_moving(self) -> bool:
        """Whether any camera was found to move."""
        return not all(self.called_static)

    @property
    def pair(self) -> bool:
        """Whether two cameras looked on."""
        return len(self.static) == 2

    @property
    def warned(self) -> bool:
        """Whether a finding is of cameras that may be wrong."""
        return bool(set(self.findings) & set(ABOUT_CAMERAS))

    @property
    def costs(self) -> float:
        """By how much of the height the error is beyond that of the true cameras."""
        return self.error - self.bound


def summary(rows: list[Row]) -> list[dict[str, Any]]:
    """Shares of the draws that hold each bar, and the worst of them."""
    static = [row for row in rows if not row.moving]
    kinds = {
        "three views or more": [row for row in static if not row.pair],
        "pairs": [row for row in static if row.pair],
    }
    table: list[dict[str, Any]] = []
    for (name, some), (limit, far) in zip(kinds.items(), ((1.1, 2.0), (1.5, 3.0)), strict=True):
        unsaid = [row for row in some if not row.warned]
        near = [row for row in some if row.ratio <= limit]
        not_far = [row for row in unsaid if row.ratio <= far]
        table += [
            _share(f"{name}: within {limit} x", some, near),
            _share(f"{name}: not beyond {far} x unsaid", unsaid, not_far),
            _share(f"{name}: called static", some, [row for row in some if not row.called_moving]),
        ]
        scores = np.array([score for row in some for score in row.focal_scores])
        if len(scores):
            worst = max(some, key=lambda row: max(row.focal_scores, default=0))
            table.append(
                {
                    "what": f"{name}: focal lengths, RMS of z",
                    "share": f"{np.sqrt(np.mean(scores**2)):.2f}",
                    "worst": f"largest {scores.max():.1f} ({worst.number})",
                }
            )
    table += _of_moving(rows)
    sure = [row for row in rows if row.certainty > 0.99]
    table += [
        _share(
            "certain of the hand: not mirrored", sure, [row for row in sure if not row.mirrored]
        ),
        _share("in step: not called out of step", rows, [r for r in rows if not _out_of_step(r)]),
    ]
    inferred = [row for row in rows if np.isfinite(row.inferred[0])]
    table += [
        _share(
            "seen by one view: median within 25 %, 95th percentile within 80 %",
            inferred,
            [row for row in inferred if row.inferred[0] <= 0.25 and row.inferred[1] <= 0.8],
        ),
        _share("reprojections within 20 image sides", rows, [r for r in rows if not r.reach > 20]),
    ]
    seconds = [row.seconds for row in rows]
    if seconds:
        median, most = np.median(seconds), max(seconds)
        table.append({"what": "seconds", "share": f"{median:.1f}", "worst": f"most {most:.1f}"})
    return table


def _of_moving(rows: list[Row]) -> list[dict[str, Any]]:
    """Shares of the draws with cameras that move, and of the calls that static ones move."""
    moving, static = [r for r in rows if r.moving], [r for r in rows if not r.moving]
    many, pairs = [r for r in moving if not r.pair], [r for r in moving if r.pair]

    def near(row: Row, ratio: float) -> bool:
        return row.error <= ratio * row.bound + MOVING_SLACK

    loud = [r for r in moving if r.warned or not r.error > max(3 * r.bound, COSTLY)]
    called = [r for r in moving if not _as_static(r) or r.costs <= COSTLY]
    return [
        _share(
            "moving, three views or more: within 2 x + 0.3 %", many, [r for r in many if near(r, 2)]
        ),
        _share(
            "moving pairs: within 3 x + 0.3 %, or a finding",
            pairs,
            [r for r in pairs if r.warned or near(r, 3)],
        ),
        _share("moving: not beyond 3 x and 3 % unsaid", moving, loud),
        _share("static: not called moving", static, [r for r in static if not r.called_moving]),
        _share("moving: not called static where it costs over 3 %", moving, called),
    ]


def _as_static(row: Row) -> bool:
    """Whether any camera that moves was called static."""
    return any(
        called and not is_so for is_so, called in zip(row.static, row.called_static, strict=True)
    )


def _out_of_step(row: Row) -> bool:
    return "views_out_of_step" in row.findings


def _share(what: str, rows: list[Row], good: list[Row]) -> dict[str, Any]:
    """Return the share of rows that are good, and the worst of the others."""
    bad = sorted((row for row in rows if row not in good), key=lambda row: -row.ratio)
    worst = ", ".join(f"{row.number} ({row.ratio:.2g})" for row in bad[:12])
    return {"what": what, "share": f"{len(good)} of {len(rows)}", "worst": worst}


def line(row: Row) -> str:
    """One line about a draw."""

    def figures() -> Iterator[str]:
        yield f"{row.number} | x{row.ratio:.2f}"
        yield f"error {100 * row.error:.3g} % (true cameras {100 * row.bound:.3g})"
        if np.isfinite(row.oracle):
            yield f"oracle x{max(row.oracle - SLACK, 0) / max(row.bound, 1e-9):.2f}"
        yield f"focal {100 * row.focal_error:.2g} % z {max(row.focal_scores, default=0):.1f}"
        yield f"turn {row.turn:.2g} deg"
        yield f"{'MIRRORED ' if row.mirrored else ''}sure {row.certainty:.3f}"
        if np.isfinite(row.inferred[0]):
            yield f"one view {100 * row.inferred[0]:.2g}, {100 * row.inferred[1]:.2g} %"
        if row.reach > 1:
            yield f"reach {row.reach:.2g}"
        if row.static != row.called_static:
            views = range(len(row.static))
            for called, word in ((True, "STATIC"), (False, "MOVING")):
                wrong = [k for k in views if row.static[k] != called == row.called_static[k]]
                if wrong:
                    yield f"CALLED {word} {', '.join(map(str, wrong))}"
        yield f"{row.seconds:.1f} s"
        yield row.words
        yield ", ".join(row.findings)

    return " | ".join(figures())
