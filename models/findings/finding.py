"""A finding, in the form that datasets, fits, models, lifts and streams share."""

import logging
import math
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from models.findings.catalogue import CATALOGUE, FindingCode, Severity

MOST_RANGES = 100  # of frames that one finding lists
Index = Annotated[int, Field(ge=0)]
Number = Annotated[float, Field(allow_inf_nan=False)]  # others become null in JSON


class Finding(BaseModel):
    """Something that was noticed, and what to do about it.

    An empty list of views, frames or keypoints means that the finding is about all of them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    code: FindingCode
    severity: Severity = Field(
        description="`warning`: results are wrong or less certain than they could be; `info`: good"
        " to know."
    )
    views: tuple[Index, ...] = Field((), description="Which views it is about; all if empty.")
    frames: tuple[tuple[Index, Index], ...] = Field(
        (),
        max_length=MOST_RANGES,
        description="Ranges of frames, the first and the last of each; all frames if empty.",
    )
    keypoints: tuple[Index, ...] = Field((), description="Which keypoints; all if empty.")
    evidence: dict[str, Number] = Field({}, description="The numbers behind it, by name.")
    effect: str = Field(description="Its effect on the results.")
    remedy: str = Field(description="What to do about it.")

    @classmethod
    def of(
        cls,
        code: FindingCode,
        *,
        views: Iterable[int] = (),
        frames: NDArray[np.bool_] | Iterable[int] = (),
        keypoints: Iterable[int] = (),
        severity: Severity | None = None,
        **evidence: float,
    ) -> Self:
        """Return the finding of a code, with its texts from the catalogue.

        `frames` are indices, or a mask (N,) of all frames; they become ranges. The default of
        `severity` is that of the catalogue.
        """
        entry = CATALOGUE[code]
        return cls(
            code=code,
            severity=entry.severity if severity is None else severity,
            views=tuple(sorted(int(view) for view in views)),
            frames=frame_ranges(frames),
            keypoints=tuple(sorted(int(keypoint) for keypoint in keypoints)),
            evidence=_finite(evidence),
            effect=entry.effect,
            remedy=entry.remedy,
        )

    def with_evidence(self, numbers: Mapping[str, float]) -> Self:
        """Return the same finding with other evidence, of which finite numbers are kept."""
        return self.model_copy(update={"evidence": _finite(numbers)})

    def __str__(self) -> str:
        """Return it as one line, for logs and terminals."""
        parts = [f"{self.severity}: {self.code}"]
        parts += [f"views {_listed(self.views)}"] if self.views else []
        parts += [f"keypoints {_listed(self.keypoints)}"] if self.keypoints else []
        if self.frames:
            parts.append("frames " + _listed([f"{a}-{b}" if a < b else a for a, b in self.frames]))
        parts += [f"{name} {value:.4g}" for name, value in self.evidence.items()]
        return ", ".join(parts) + f". {self.effect} {self.remedy}"


def _finite(numbers: Mapping[str, float]) -> dict[str, float]:
    return {name: float(value) for name, value in numbers.items() if math.isfinite(value)}


def dumped(findings: Iterable[Finding]) -> list[dict[str, Any]]:
    """Return findings as plain data, for records and JSON."""
    return [finding.model_dump(mode="json") for finding in findings]


def log_findings(logger: logging.Logger, about: str, findings: Iterable[Finding]) -> None:
    """Log findings about something, one line each."""
    for finding in findings:
        level = logging.WARNING if finding.severity == "warning" else logging.INFO
        logger.log(level, "%s: %s", about, finding)


def frame_ranges(frames: NDArray[np.bool_] | Iterable[int]) -> tuple[tuple[int, int], ...]:
    """Return (first, last) of every run of consecutive frames, of a mask (N,) or of indices.

    Where there are more than `MOST_RANGES`, the nearest runs are joined.
    """
    array = frames if isinstance(frames, np.ndarray) else np.array(sorted(frames), np.int64)
    indices = np.flatnonzero(array) if array.dtype == bool else np.unique(array)
    return _joined(indices, indices)


def merged(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Join findings of parts of a capture that differ only in their frames and evidence.

    Of numbers of one name the largest is kept. A part that names no frames adds none.
    """
    alike: dict[object, list[Finding]] = {}
    for finding in findings:
        key = (finding.code, finding.severity, finding.views, finding.keypoints)
        alike.setdefault(key, []).append(finding)
    return tuple(_merge(parts) for parts in alike.values())


def _merge(parts: list[Finding]) -> Finding:
    ranges = np.array(sorted(some for part in parts for some in part.frames), np.int64)
    firsts, lasts = ranges.reshape(-1, 2).T
    evidence: dict[str, float] = {}
    for part in parts:
        for name, value in part.evidence.items():
            evidence[name] = max(value, evidence.get(name, value))
    frames = _joined(firsts, np.maximum.accumulate(lasts))
    return parts[0].model_copy(update={"frames": frames, "evidence": evidence})


def _joined(firsts: NDArray[np.int64], lasts: NDArray[np.int64]) -> tuple[tuple[int, int], ...]:
    """Sort ranges, and join those that touch, and the nearest ones if they are too many."""
    if not len(firsts):
        return ()
    gaps = firsts[1:] - lasts[:-1]
    breaks = np.flatnonzero(gaps > 1)
    if len(breaks) >= MOST_RANGES:
        widest = np.argsort(-gaps[breaks], kind="stable")[: MOST_RANGES - 1]
        breaks = np.sort(breaks[widest])
    starts = firsts[np.concatenate(([0], breaks + 1))].tolist()
    ends = lasts[np.concatenate((breaks, [len(lasts) - 1]))].tolist()
    return tuple(zip(starts, ends, strict=True))


def _listed(items: Iterable[object], most: int = 8) -> str:
    texts = [str(item) for item in items]
    return " ".join(texts[:most]) + (f" and {len(texts) - most} more" * (len(texts) > most))
