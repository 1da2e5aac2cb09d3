"""The decay rate and the frequency of a sampled motion, fitted to its last part, with their errors.

Takes: samples of positions at equal intervals. Gives: `Fit`, `Oscillation`, `fit_motion`.
Guarantees: a rate or a frequency has an error, found from parts of the same samples; where parts disagree the
error is large.
Does not: prove anything, or know the equations (see `analysis`).

A motion of a linear system that no force changes is a sum of exponentials z_i^k about a constant and a ramp.
Second differences remove these two. The poles z_i are those of ESPRIT (Roy and Kailath, IEEE Trans. ASSP 37
(1989) 984): the shift of the leading left singular vectors of a Hankel matrix, whose columns are of all
positions. The decay rate is Re log z/Δ, the frequency |Im log z|/(2π Δ). Where the poles of parts of the
samples disagree, as of a motion with impacts or lost packets, the rate is the slope of the logarithm of the
range over time, with its standard error (logarithmic decrement).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

PENCIL = 64  # rows of a Hankel matrix
FEWEST = 24  # samples of a fit
MOST = 600  # samples of a fit: more make it no better and take longer
CHANNELS = 4  # positions of a fit, those that move most
A_PERIOD = 8  # samples in the period of the fastest motion, where there are as many
NOISE = 1e-9  # singular values below this share of the largest are rounding, or the error of an integration
POLES = 20  # the most of a fit
VISIBLE = 1e-4  # share of the largest amplitude from which a pole counts
GROWING = 1e-6  # the same of one that grows
AT_REST = 1e-7  # share of the range of all below which a motion has ended
SAFETY = 3.0  # times what parts of the samples disagree by
SEGMENTS, FEWEST_SEGMENTS = 8, 4  # of the window, for the range over time: each of a period or more
RAMP = 0.05  # share of the range of the window from which a ramp counts
# An error of the rate times the window, or of a frequency as a share of it, that leaves open whether a motion
# oscillates on.
OPEN = 0.5
LARGE = 0.1  # share of the largest amplitude from which a pole that is not known leaves the rate open
FADED = 1e-10  # share of the largest second difference from which a sample counts
STEADY = 0.5  # share of the range of the last quarter that the step to it must be, for a drift
KEPT_SHARE = 0.8  # share of a step that the next but one must keep, for a drift
LATE = 0.9  # share of the samples: a motion that ends before has ended
UNIT = float(np.finfo(np.float64).eps)
PARTS = ((0.0, 0.7), (0.3, 1.0))  # of the window, which are fitted again


@dataclass(frozen=True, slots=True)
class Oscillation:
    """A frequency in Hz with its error, of the position at `index`, from crest to trough by `size` in SI."""

    index: int
    size: float
    frequency: float
    error: float


@dataclass(frozen=True, slots=True)
class Fit:
    """The last part of a motion.

    `rate` in 1/s is that of the slowest exponential, positive if it grows, right to `error`; 0 ± inf where
    nothing is known. `span` is the length of the window in seconds, and `ended` whether nothing moves after
    it. `oscillation` is the largest one at the end, None if nothing oscillates. `ramp`: some
    position moves on at a constant velocity, or at a constant acceleration.
    """

    rate: float
    error: float
    span: float
    ended: bool
    oscillation: Oscillation | None
    ramp: bool

    @property
    def decays(self) -> bool:
        """Whether the slowest exponential decays, its error included."""
        return self.rate + self.error < 0

    @property
    def grows(self) -> bool:
        """Whether it grows, its error included."""
        return self.rate - self.error > 0

    @property
    def lasts(self) -> bool:
        """Whether an oscillation neither decays nor grows visibly in the window, its error included."""
        crests = self.oscillation
        if crests is None or crests.error > OPEN * crests.frequency:
            return False
        return (abs(self.rate) + self.error) * self.span < OPEN and not self.decays and not self.grows


# A channel's place, frequency and error.
_Line = tuple[int, float, float]


@dataclass(frozen=True, slots=True)
class _Rate:
    """A rate in 1/s and its error, the line of the largest oscillation, and whether something drifts."""

    rate: float
    error: float
    line: _Line | None
    ramp: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Poles:
    """Poles s (k,) in 1/s, amplitudes at the end (k, channels), and the ramps over the window (channels,)."""

    s: Complexes
    amplitudes: Floats
    ramps: Floats


def fit_motion(step: float, values: Floats, scale: Floats) -> Fit | None:
    """Fit the last part of a motion; None if nothing moves in it, or the samples are too few.

    Parameters
    ----------
    step
        Seconds from row to row.
    values
        Positions (rows, channels).
    scale
        The range of each position (channels,) in the entire motion; what has none counts for nothing.

    Examples
    --------
    >>> time = np.arange(2000) * 1e-3
    >>> x = np.exp(-time / 4) * np.cos(2 * np.pi * 14.41 * time)
    >>> fit = fit_motion(1e-3, x[:, None], np.array([2.0]))
    >>> f"{fit.rate:.6f} {fit.oscillation.frequency:.6f}"
    '-0.250000 14.410000'
    """
    channels = np.flatnonzero((scale > 0) & np.isfinite(scale))
    if len(values) < FEWEST or not len(channels):
        return None
    scaled = (values[:, channels] - values[-1, channels]) / scale[channels]
    moving = np.flatnonzero((np.abs(scaled) > AT_REST).any(axis=1))
    if not len(moving):
        return None
    last = min(int(moving[-1]) + 1, len(scaled) - 1)
    ended = last < LATE * len(scaled)
    # A fast-growing motion is at rounding level, relative to its end, until shortly before it.
    curve = np.abs(np.diff(scaled[: last + 1], 2, axis=0)).max(axis=1, initial=0.0)
    begun = int(np.argmax(curve > FADED * curve.max(initial=0.0)))
    first = max(min(max(last // 2, begun), last + 1 - FEWEST), 0)
    window = scaled[first : last + 1]
    span = step * (len(window) - 1)
    ranges = np.ptp(window, axis=0)
    chosen = np.argsort(-ranges, kind="stable")[:CHANNELS]
    chosen = chosen[ranges[chosen] > VISIBLE * ranges[chosen[0]]]
    window, indices = window[:, chosen], channels[chosen]
    stride = _stride(window)
    thin = window[(len(window) - 1) % stride :: stride][-MOST:]
    result = _by_poles(step * stride, thin)
    if result is None or result.error * span > OPEN:
        other = _by_ranges(step, window)
        if result is None or (other is not None and other.error < result.error):
            result = other
    if result is None:
        result = _Rate(0.0, math.inf, None, _drifts(window))
    crests = None
    if result.line is not None:
        index, frequency, off = result.line
        end = window[-(len(window) // 4) :, index]
        size = float(np.ptp(_straightened(end) if result.ramp else end) * scale[indices[index]])
        crests = Oscillation(int(indices[index]), size, frequency, off)
    return Fit(result.rate, result.error, span, ended, crests, result.ramp)


def _stride(window: Floats) -> int:
    """Return the rows from sample to sample, so that the fastest visible motion is sampled well."""
    steps = np.diff(window, axis=0)
    clear = np.abs(steps) > AT_REST * np.ptp(window, axis=0)
    signs = np.sign(steps) * clear
    turns = int((signs[1:] * signs[:-1] < 0).sum(axis=0).max(initial=0))
    period = 2 * len(window) / turns if turns else math.inf
    return int(max(1, min(len(window) // (MOST // 2), period / A_PERIOD)))


def _by_poles(step: float, window: Floats) -> _Rate | None:
    """Return the rate by the poles of samples (rows, channels), None if these are not found again."""
    every = _poles(step, window)
    if every is None:
        return None
    count = len(window)
    parts = [_poles(step, window[int(low * count) : int(high * count)]) for low, high in PARTS]
    away = [np.abs(part.s[None, :] - every.s[:, None]).min(axis=1) for part in parts if part is not None]
    if len(away) < len(parts):
        return None
    off = SAFETY * np.max(away, axis=0) + NOISE / (step * count)
    size = every.amplitudes.max(axis=1)
    # A spurious pole is not found again in a part of the samples.
    sure = off < np.maximum(np.abs(every.s), 1 / (step * count))
    least = np.where(every.s.real > off, GROWING, VISIBLE) * size.max()
    known = np.flatnonzero((size >= least) & sure)
    if not len(known) or size[known].max() < size.max():
        return None
    slowest = known[np.argmax(every.s.real[known])]
    # A large one that is not known to decay faster leaves the rate open.
    large = np.flatnonzero(size > LARGE * size.max())
    uncertainty = max(float((every.s.real[large] - every.s.real[slowest]).max()), 0.0)
    turning = [i for i in known if abs(every.s[i].imag) > max(float(off[i]), 1 / (step * count))]
    line = None
    if turning:
        largest = max(turning, key=lambda i: float(size[i]))
        frequency, error = (float(v / (2 * np.pi)) for v in (abs(every.s[largest].imag), off[largest]))
        line = int(np.argmax(every.amplitudes[largest])), frequency, error
    ramp = bool((every.ramps > RAMP * np.ptp(window, axis=0)).any()) and _drifts(window)
    return _Rate(float(every.s.real[slowest]), float(off[slowest]) + uncertainty, line, ramp)


def _poles(step: float, window: Floats) -> _Poles | None:
    """Return the poles of the second differences of samples (rows, channels), None if there are none."""
    curve = np.diff(window, 2, axis=0)
    size, rounding = float(np.abs(curve).max(initial=0.0)), 16 * UNIT * float(np.abs(window).max())
    if len(curve) < FEWEST // 2 or size <= rounding:
        return None
    rows = min(PENCIL, len(curve) // 2)
    blocks = [np.lib.stride_tricks.sliding_window_view(column, rows) for column in curve.T / size]
    triangle = np.asarray(np.linalg.qr(np.concatenate(blocks), mode="r"))
    left, singular, _ = np.linalg.svd(triangle.T)
    floor = max(NOISE, rounding / size)
    order = min(int((singular > floor * singular[0]).sum()), POLES, rows // 2)
    shift = np.linalg.lstsq(left[:-1, :order], left[1:, :order], rcond=None)[0]
    z = np.linalg.eigvals(shift).astype(complex)
    z = z[(np.abs(z) > NOISE) & (np.abs(z - 1) > NOISE)]
    if not len(z):
        return None
    # Columns of size 1 at their larger end; then a constant, a ramp and a parabola of the positions.
    count = np.arange(len(window))
    basis = z[None, :] ** (count[:, None] - np.where(np.abs(z) > 1, count[-1], 0))
    line = count / count[-1]
    columns = np.concatenate([basis, np.stack([line**0, line, line**2], axis=1)], axis=1)
    weights = np.linalg.lstsq(columns, window.astype(complex), rcond=UNIT)[0]
    amplitudes = np.abs(weights[: len(z)]) * np.abs(basis[-1])[:, None]
    return _Poles(np.log(z) / step, amplitudes, np.abs(weights[-2:]).sum(axis=0))


def _by_ranges(step: float, window: Floats) -> _Rate | None:
    """Return the rate by the range of the largest channel by segment, None if it turns seldom."""
    straight = _straightened(window)
    channel = int(np.argmax(np.ptp(straight, axis=0)))
    motion = straight[:, channel]
    cross = np.flatnonzero(motion[1:] * motion[:-1] < 0)
    segments = min(SEGMENTS, len(cross) // 2)
    if segments < FEWEST_SEGMENTS or np.ptp(motion) <= AT_REST * np.ptp(window):
        return None
    ranges = np.array([float(np.ptp(part)) for part in np.array_split(motion, segments)])
    if not (ranges > 0).all():
        return None
    at, logs = (np.arange(segments) - (segments - 1) / 2) * step * len(motion) / segments, np.log(ranges)
    rate = float(at @ logs / (at @ at))
    rest = logs - logs.mean() - rate * at
    error = SAFETY * math.sqrt(float(rest @ rest) / (segments - 2) / float(at @ at))
    halves = np.diff(step * (cross + motion[cross] / (motion[cross] - motion[cross + 1])))
    frequency = float(1 / (2 * halves.mean()))
    off = SAFETY * frequency * float(halves.std() / halves.mean()) / math.sqrt(len(halves))
    return _Rate(rate, error, (channel, frequency, off), _drifts(window))


def _straightened(window: Floats) -> Floats:
    """Return samples (rows, …) less the straight lines that fit them best."""
    line = np.linspace(-1, 1, len(window))
    rows = window.reshape(len(window), -1)
    rows = rows - rows.mean(axis=0)
    rows = rows - line[:, None] * (line @ rows / (line @ line))
    return np.asarray(rows.reshape(window.shape))


def _drifts(window: Floats) -> bool:
    """Return whether the quarter means of a channel drift in one direction by steps of like size.

    The last step must also be a large share of the range of the last quarter: an oscillation is no drift.
    """
    quarters = np.array_split(window, 4)
    steps = np.diff([part.mean(axis=0) for part in quarters], axis=0)
    onwards = (np.sign(steps) == np.sign(steps[0])).all(axis=0)
    kept = np.abs(steps[2]) > KEPT_SHARE * np.abs(steps[0])
    large = np.abs(steps[2]) > np.maximum(RAMP * np.ptp(window, axis=0), STEADY * np.ptp(quarters[3], axis=0))
    return bool((onwards & kept & large).any())
