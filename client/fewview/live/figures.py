"""Figures of a bridge, once a second: rates, latencies, what was lost."""

import json
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import IO, Any

import numpy as np

MOST_REASONS = 50  # that are printed, however many there are


class Figures:
    """Counts frames and their latency, and prints each reason for a bad one once."""

    def __init__(self, show: Callable[[str], None], file: IO[str] | None) -> None:
        self._show, self._file, self._last = show, file, ""
        self._since = time.perf_counter()
        self._latencies: list[float] = []
        self._shown: set[str] = set()
        self._counts: Counter[str] = Counter()

    def show(self, line: str) -> None:
        """Print a line; a terminal that is gone does not end the bridge."""
        with suppress(OSError):
            self._show(line)

    def answered(self, come: float) -> None:
        """Count a frame that came at a time of perf_counter, and has been sent on now."""
        self._latencies.append(time.perf_counter() - come)

    def count(self, what: str, reason: str | None = None) -> None:
        """Count a ``bad``, ``dropped`` or ``unsent`` frame, or a reconnect; print reasons once."""
        self._counts[what] += 1
        if reason is not None and reason not in self._shown and len(self._shown) < MOST_REASONS:
            self._shown.add(reason)
            self.show(f"{what}: {reason}")

    def report(self) -> None:
        """Print what happened since the last report, and write it to the file as a line of JSON.

        While nothing happens that is printed once. Without room for the file there is none.
        """
        now = time.perf_counter()
        milliseconds, seconds = 1000 * np.array(self._latencies), now - self._since
        self._latencies, self._since = [], now
        median, late = (
            np.percentile(milliseconds, (50, 99)).tolist() if len(milliseconds) else (None, None)
        )
        record: dict[str, Any] = {
            "time": time.time(),
            "seconds": seconds,
            "frames": len(milliseconds),
            "frames_per_second": len(milliseconds) / seconds,
            "latency_median_ms": median,
            "latency_p99_ms": late,
            **{what: self._counts[what] for what in ("bad", "dropped", "unsent", "reconnects")},
        }
        latency = "" if median is None else f", latency {median:.1f} ms, p99 {late:.1f} ms"
        lost = "".join(f", {count} {what}" for what, count in self._counts.items())
        line = f"{record['frames_per_second']:.1f} frames/s{latency}{lost}"
        if line != self._last:
            self.show(line)
        self._last = line
        if self._file is not None:
            try:
                self._file.write(json.dumps(record) + "\n")
                self._file.flush()
            except OSError as error:
                self.show(f"--metrics: {error}; the file gets no more lines")
                with suppress(OSError):  # that of what could not be written
                    self._file.close()
                self._file = None
