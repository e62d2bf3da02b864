"""Smoothing in time while frames arrive: each is returned a few frames after it arrived.

This is the causal form of `MotionModel.smooth`. A Kalman filter runs over all frames so far. The
smoother of Rauch, Tung and Striebel runs from the newest frame back over the last few (fixed-lag
smoothing; Anderson & Moore, *Optimal Filtering*, 1979, section 7.3). Only these frames are kept,
and the state of the filter before them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.known_poses import known_poses
from models.capture.motion import (
    FILLED,
    FILLING_ROUNDS,
    LEAST_CLIP,
    LONGEST_STEP,
    REACH,
    bridged,
    explained,
    falling_apart,
)
from models.capture.noise_removal import NoiseRemoval
from models.capture.observations import Observations, as_observations, join_frames, pixels_of
from models.capture.tracks import CUT_NEIGHBOURS, cuts_among, jumps_between
from models.numerics.kalman import advance, smooth
from models.settings.times import MAX_LAG

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


class _Frame(NamedTuple):
    """A frame that waits, or one before it."""

    observations: Observations  # of this frame alone
    pixels: Float64  # (K, P, 2)
    observed: Bool  # (K, P)
    time: float  # seconds


class _Window(NamedTuple):
    """The n frames that wait, smoothed, in the D coordinates in which they fall apart."""

    pixels: Float64  # (n, K, P, 2)
    observed: Bool  # (n, K, P)
    given: Float64  # (n, D) keypoints, filled where they were not observed
    values: Float64  # (n, D)
    variances: Float64  # (n, D)
    steps: Float64  # (n,) since the frame before, in usual steps; 0 where a clip begins


class FixedLag:
    """Smooths the frames of one film, in the order in which they were taken."""

    def __init__(self, removal: NoiseRemoval, views: Sequence[int], lag: int) -> None:
        """Smooth frames of `views` of the fit, each by what comes up to `lag` frames later.

        Raises
        ------
        ValueError
            If the fit learnt nothing of how keypoints move, or `lag` is not 0 to `MAX_LAG`.
        """
        if removal.motion is None:
            raise ValueError(
                "lag needs a prior that smooths in time: fit a dataset with fps or times, whose"
                " keypoints are noisy and move steadily from frame to frame"
            )
        if not 0 <= lag <= MAX_LAG:
            raise ValueError(f"lag must be 0 to {MAX_LAG} frames, got {lag}")
        self._motion, self._views, self._lag = removal.motion, views, lag
        self._noise = np.repeat(self._motion.noise[list(views)].reshape(-1), 2)  # (D,)
        self._basis, self._rates = falling_apart(self._motion.covariance_of(views), self._noise)
        denoiser = removal.denoiser
        self._poses = denoiser and known_poses(denoiser, views, self._noise, self._basis)
        self._begin()

    def _begin(self) -> None:
        self._frames: list[_Frame] = []
        self._jumps: list[Float64] = []  # (K,) each, to the frames that wait and some before
        # (n, D) the window over the noise, smoothed, and its newest frame, which may have left.
        self._part = self._latest = np.empty((0, len(self._noise)))
        self._state: Float64 | None = None  # (D, 5) of the filter, at the frame before the window
        self._before: _Frame | None = None
        self._length = 0  # of the clip up to that frame
        self._known: Bool | None = None  # (K, P) what that clip has shown
        # Of the last frames returned: what was removed, over the noise, and what was observed.
        shape = len(self._views), self._motion.noise.shape[1]
        self._removed, self._observed = np.empty((0, *shape, 2)), np.empty((0, *shape), np.bool_)

    def push(self, observations: Observations, time: float) -> Observations | None:
        """Take the next frame, taken at `time` in seconds; return the one that is `lag` before.

        None while there is none.

        Raises
        ------
        ValueError
            If it is not one frame of the views, or its time is not after that of the last one.
        """
        pixels, observed = pixels_of(observations)
        if pixels.size != len(self._noise):
            raise ValueError(
                f"expected one frame of {len(self._views)} views, got {pixels.shape[:3]}"
            )
        last = self._frames[-1] if self._frames else self._before
        if last is not None and not time > last.time:
            raise ValueError(f"times must increase: {time:g} s is not after {last.time:g} s")
        frame = _Frame(observations, pixels[0], observed[0], time)
        if last is not None:
            seen = np.stack((last.observed, frame.observed)).astype(np.float64)
            self._jumps.extend(jumps_between(np.stack((last.pixels, frame.pixels)), seen))
        self._frames.append(frame)
        return self._take_first(1) if len(self._frames) > self._lag else None

    def flush(self) -> Observations | None:
        """Return the frames that wait, if any, and begin anew: the next frame has none before."""
        waiting = self._take_first(len(self._frames)) if self._frames else None
        self._begin()
        return waiting

    def _take_first(self, count: int) -> Observations:
        """Smooth the window, remove its first `count` frames and return them."""
        window = self._smooth()
        noise = self._noise.reshape(window.pixels.shape[1:])
        removed = window.pixels / noise - self._part.reshape(window.pixels.shape)
        removed = np.concatenate((self._removed, np.where(window.observed[..., None], removed, 0)))
        observed = np.concatenate((self._observed, window.observed))
        done = len(self._removed)
        near, end = slice(None, done + count + REACH), done + count
        can_be_noise = explained(removed[near], observed[near])[done:]
        taken = []
        for n in range(count):
            if can_be_noise[n] and self._clip_length(window, n) >= LEAST_CLIP:
                taken.append(self._with_values(n, window.values[n], window.variances[n]))
            elif self._poses is not None:
                taken.append(self._with_values(n, window.given[n], np.ones(len(self._noise))))
            else:
                taken.append(self._frames[n].observations)
        for n in range(count):
            self._pass(window, n)
        recent = slice(max(end - REACH, 0), end)
        self._removed, self._observed = removed[recent], observed[recent]
        self._part = self._part[count:]
        del self._frames[:count]
        return taken[0] if count == 1 else join_frames(taken)

    def _smooth(self) -> _Window:
        """Go forwards from the state before the window, and back from its end."""
        steps = self._steps()
        observed = np.stack([frame.observed for frame in self._frames])
        shown = np.repeat(observed.reshape(len(observed), -1), 2, axis=1)  # (n, D)
        there = np.any(shown, axis=1)
        pixels = np.stack([frame.pixels for frame in self._frames])
        given = pixels.reshape(shown.shape) / self._noise
        if self._before is None:
            part = bridged(pixels, observed) / self._noise
        else:  # what is not seen goes on as it was
            part = np.where(shown, given, np.concatenate((self._part, self._latest))[: len(given)])
        gaps = ~shown.all(1)
        scores = np.where(shown, given, part) @ self._basis
        for _ in range(FILLING_ROUNDS if gaps.any() else 1):
            smoothed = smooth(scores.T, steps, there, self._rates, 1.0, self._state)
            values = smoothed.values.T
            filling = values[gaps] @ self._basis.T
            moved = np.abs(filling - part[gaps])[~shown[gaps]].max(initial=0.0)
            part[gaps] = filling
            if moved < FILLED:
                break
            scores[gaps] = np.where(shown[gaps], given[gaps], filling) @ self._basis
        part[~gaps] = values[~gaps] @ self._basis.T
        self._part, self._latest = part, part[-1:]
        return _Window(pixels, observed, scores, values, smoothed.variances.T, steps)

    def _steps(self) -> Float64:
        """Return the time (n,) since the frame before, in usual steps; 0 where a clip begins."""
        times = np.array([frame.time for frame in self._frames])
        before = times[0] if self._before is None else self._before.time
        steps = np.diff(times, prepend=before) / self._motion.step
        steps[steps > LONGEST_STEP] = 0.0
        most = max(len(times) + CUT_NEIGHBOURS, 2 * CUT_NEIGHBOURS + 1)
        del self._jumps[:-most]
        if self._jumps:
            cuts = np.any(cuts_among(np.stack(self._jumps)), axis=1)[-len(times) :]
            steps[len(steps) - len(cuts) :][cuts] = 0.0
        if self._known is not None:
            for n, frame in enumerate(self._frames):
                if steps[n] == 0:
                    break
                if np.any(frame.observed & ~self._known):
                    # The filter's state has a value for it, but it was never observed in the clip.
                    steps[n] = 0.0
                    break
        return steps

    def _clip_length(self, window: _Window, n: int) -> int:
        """Count the frames of the clip that a frame belongs to, as far as they are there."""
        begins = np.flatnonzero(window.steps == 0)
        first, end = begins[begins <= n], begins[begins > n]
        stop = int(end[0]) if len(end) else len(window.steps)
        return stop - int(first[-1]) if len(first) else stop + self._length

    def _with_values(self, n: int, values: Float64, variances: Float64) -> Observations:
        """Return a frame with these values and variances (D,), drawn towards the fit's poses."""
        frame = self._frames[n]
        if self._poses is not None:
            values = self._poses.combined(values, variances)
        pixels = (self._basis @ values * self._noise).reshape(frame.pixels.shape)
        shown = np.where(frame.observed[..., None], pixels, np.nan)
        return as_observations(shown[None], frame.observations.weights)

    def _pass(self, window: _Window, n: int) -> None:
        """Let the filter go over a frame that leaves the window."""
        frame = self._frames[n]
        if window.steps[n] == 0:
            end = np.flatnonzero(window.steps[n + 1 :] == 0)
            clip = self._frames[n : n + 1 + end[0]] if len(end) else self._frames[n:]
            self._known = np.logical_or.reduce([f.observed for f in clip])
            self._length = 0
        state = np.zeros((len(self._noise), 5)) if self._state is None else self._state
        step, there = float(window.steps[n]), bool(frame.observed.any())
        self._state = advance(state, window.given[n], step, there, self._rates, 1.0)
        self._length += 1
        self._before = frame
