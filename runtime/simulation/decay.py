"""The decay rate and the frequency of a sampled motion, fitted to its last part, with their errors.

Takes: samples of positions at equal intervals. Gives: `Fit`, `Oscillation`, `fit_motion`.
Guarantees: a rate or a frequency has an error, found from parts of the same samples; where parts disagree the
error is large.
Does not: prove anything, or use the equations (see `analysis`).

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
MOST = 600  # samples of a fit: more samples take longer without a better fit
CHANNELS = 4  # positions of a fit, those of the largest range
A_PERIOD = 8  # samples per period of the fastest motion, if there are enough samples
NOISE = 1e-9  # share of the largest singular value below which others are rounding or integration errors
POLES = 20  # the most of a fit
VISIBLE = 1e-4  # share of the largest amplitude from which a pole counts
GROWING = 1e-6  # the same for a growing pole
AT_REST = 1e-7  # share of the range over the entire motion below which a motion has ended
SAFETY = 3.0  # factor on the difference between fits of parts of the samples
SEGMENTS, FEWEST_SEGMENTS = 8, 4  # of the window, for the range over time: each of a period or more
RAMP = 0.05  # share of the range of the window from which a ramp counts
# The limit of (error of the rate · length of the window), and of the relative error of a frequency, above
# which a sustained oscillation is undecided.
OPEN = 0.5
LARGE = 0.1  # share of the largest amplitude from which an uncertain pole adds to the error of the rate
FADED = 1e-10  # share of the largest second difference from which a sample counts
STEADY = 0.5  # least step to the mean of the last quarter, as a share of this quarter's range, for a drift
KEPT_SHARE = 0.8  # least ratio of the last step to the first, for a drift
LATE = 0.9  # share of the samples before which a motion must end to count as ended
UNIT = float(np.finfo(np.float64).eps)
PARTS = ((0.0, 0.7), (0.3, 1.0))  # of the window, fitted again for the error


@dataclass(frozen=True, slots=True)
class Oscillation:
    """An oscillation of the position at `index`: frequency in Hz with its error, peak-to-peak
    `size` in SI.
    """

    index: int
    size: float
    frequency: float
    error: float


@dataclass(frozen=True, slots=True)
class Fit:
    """The fit of the last part of a motion.

    `rate` in 1/s is that of the slowest exponential, positive if it grows, with the error bound `error`; 0 ±
    inf if it is unknown. `span` is the length of the window in seconds; `ended` states that all positions are
    constant after it. `oscillation` is the largest oscillation at the end, None without oscillation. `ramp`
    states that some position moves at a constant velocity or acceleration.
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
        """Whether the slowest exponential grows, its error included."""
        return self.rate - self.error > 0

    @property
    def lasts(self) -> bool:
        """Whether an oscillation neither decays nor grows visibly in the window, the rate's error
        included.
        """
        largest = self.oscillation
        if largest is None or largest.error > OPEN * largest.frequency:
            return False
        return (abs(self.rate) + self.error) * self.span < OPEN and not self.decays and not self.grows


# A channel's index, frequency in Hz and error in Hz.
_Line = tuple[int, float, float]


@dataclass(frozen=True, slots=True)
class _Rate:
    """A rate in 1/s and its error, the line of the largest oscillation, and whether some position drifts."""

    rate: float
    error: float
    line: _Line | None
    ramp: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Poles:
    """Poles s (k,) in 1/s, amplitudes at the end (k, channels), and drifts over the window (channels,)."""

    s: Complexes
    amplitudes: Floats
    ramps: Floats


def fit_motion(step: float, values: Floats, scale: Floats) -> Fit | None:
    """Return the fit of the last part of a motion; None if all positions are constant, or samples too few.

    Parameters
    ----------
    step
        The sampling period in seconds.
    values
        Positions (rows, channels).
    scale
        The range of each position (channels,) over the entire motion; positions of range 0 are left out.

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
    second_differences = np.abs(np.diff(scaled[: last + 1], 2, axis=0)).max(axis=1, initial=0.0)
    first_visible = int(np.argmax(second_differences > FADED * second_differences.max(initial=0.0)))
    first = max(min(max(last // 2, first_visible), last + 1 - FEWEST), 0)
    window = scaled[first : last + 1]
    span = step * (len(window) - 1)
    ranges = np.ptp(window, axis=0)
    largest = np.argsort(-ranges, kind="stable")[:CHANNELS]
    largest = largest[ranges[largest] > VISIBLE * ranges[largest[0]]]
    window, indices = window[:, largest], channels[largest]
    stride = _sample_stride(window)
    samples = window[(len(window) - 1) % stride :: stride][-MOST:]
    result = _rate_from_poles(step * stride, samples)
    if result is None or result.error * span > OPEN:
        from_ranges = _rate_from_ranges(step, window)
        if result is None or (from_ranges is not None and from_ranges.error < result.error):
            result = from_ranges
    if result is None:
        result = _Rate(0.0, math.inf, None, _is_drifting(window))
    oscillation = None
    if result.line is not None:
        index, frequency, frequency_error = result.line
        last_quarter = window[-(len(window) // 4) :, index]
        size = float(
            np.ptp(_detrended(last_quarter) if result.ramp else last_quarter) * scale[indices[index]]
        )
        oscillation = Oscillation(int(indices[index]), size, frequency, frequency_error)
    return Fit(result.rate, result.error, span, ended, oscillation, result.ramp)


def _sample_stride(window: Floats) -> int:
    """Return the number of rows per sample of the fit, such that the fastest visible motion is well
    sampled.

    A ramp or a slow motion hides the reversals of a faster one in the steps, but not in their differences.
    """
    motion = _detrended(window)
    reversals = 0
    for order, least in ((1, AT_REST), (2, VISIBLE * LARGE)):
        differences = np.diff(motion, order, axis=0)
        signs = np.sign(differences) * (np.abs(differences) > least * np.ptp(motion, axis=0))
        reversals = max(reversals, int((signs[1:] * signs[:-1] < 0).sum(axis=0).max(initial=0)))
    period = 2 * len(window) / reversals if reversals else math.inf
    return int(max(1, min(len(window) // (MOST // 2), period / A_PERIOD)))


def _rate_from_poles(step: float, window: Floats) -> _Rate | None:
    """Return the rate from the poles of samples (rows, channels), None if parts of the samples disagree."""
    poles = _poles(step, window)
    if poles is None:
        return None
    count = len(window)
    parts = [_poles(step, window[int(low * count) : int(high * count)]) for low, high in PARTS]
    differences = [
        np.abs(part.s[None, :] - poles.s[:, None]).min(axis=1) for part in parts if part is not None
    ]
    if len(differences) < len(parts):
        return None
    errors = SAFETY * np.max(differences, axis=0) + NOISE / (step * count)
    amplitudes = poles.amplitudes.max(axis=1)
    # A spurious pole is not found again in a part of the samples.
    reliable = errors < np.maximum(np.abs(poles.s), 1 / (step * count))
    least = np.where(poles.s.real > errors, GROWING, VISIBLE) * amplitudes.max()
    visible = np.flatnonzero((amplitudes >= least) & reliable)
    if not len(visible) or amplitudes[visible].max() < amplitudes.max():
        return None
    slowest = visible[np.argmax(poles.s.real[visible])]
    # A large pole that is not known to decay faster adds to the error of the rate.
    large = np.flatnonzero(amplitudes > LARGE * amplitudes.max())
    uncertainty = max(float((poles.s.real[large] - poles.s.real[slowest]).max()), 0.0)
    oscillating = [i for i in visible if abs(poles.s[i].imag) > max(float(errors[i]), 1 / (step * count))]
    line = None
    if oscillating:
        largest = max(oscillating, key=lambda i: float(amplitudes[i]))
        frequency, error = (
            float(angular / (2 * np.pi)) for angular in (abs(poles.s[largest].imag), errors[largest])
        )
        line = int(np.argmax(poles.amplitudes[largest])), frequency, error
    ramp = bool((poles.ramps > RAMP * np.ptp(window, axis=0)).any()) and _is_drifting(window)
    return _Rate(float(poles.s.real[slowest]), float(errors[slowest]) + uncertainty, line, ramp)


def _poles(step: float, window: Floats) -> _Poles | None:
    """Return the poles of the second differences of samples (rows, channels), None if there are none."""
    second_differences = np.diff(window, 2, axis=0)
    size, rounding = (
        float(np.abs(second_differences).max(initial=0.0)),
        16 * UNIT * float(np.abs(window).max()),
    )
    if len(second_differences) < FEWEST // 2 or size <= rounding:
        return None
    rows = min(PENCIL, len(second_differences) // 2)
    hankel_blocks = [
        np.lib.stride_tricks.sliding_window_view(column, rows) for column in second_differences.T / size
    ]
    triangle = np.asarray(np.linalg.qr(np.concatenate(hankel_blocks), mode="r"))
    left_vectors, singular, _ = np.linalg.svd(triangle.T)
    floor = max(NOISE, rounding / size)
    order = min(int((singular > floor * singular[0]).sum()), POLES, rows // 2)
    shift = np.linalg.lstsq(left_vectors[:-1, :order], left_vectors[1:, :order], rcond=None)[0]
    z = np.linalg.eigvals(shift).astype(complex)
    z = z[(np.abs(z) > NOISE) & (np.abs(z - 1) > NOISE)]
    if not len(z):
        return None
    # Columns of size 1 at their larger end; then a constant, a ramp and a parabola of the positions.
    sample_numbers = np.arange(len(window))
    basis = z[None, :] ** (sample_numbers[:, None] - np.where(np.abs(z) > 1, sample_numbers[-1], 0))
    relative_time = sample_numbers / sample_numbers[-1]
    columns = np.concatenate(
        [basis, np.stack([relative_time**0, relative_time, relative_time**2], axis=1)], axis=1
    )
    weights = np.linalg.lstsq(columns, window.astype(complex), rcond=UNIT)[0]
    amplitudes = np.abs(weights[: len(z)]) * np.abs(basis[-1])[:, None]
    return _Poles(np.log(z) / step, amplitudes, np.abs(weights[-2:]).sum(axis=0))


def _rate_from_ranges(step: float, window: Floats) -> _Rate | None:
    """Return the rate from the range of the largest channel over time, None if it has too few
    oscillations.
    """
    detrended = _detrended(window)
    channel = int(np.argmax(np.ptp(detrended, axis=0)))
    motion = detrended[:, channel]
    crossings = np.flatnonzero(motion[1:] * motion[:-1] < 0)
    segments = min(SEGMENTS, len(crossings) // 2)
    if segments < FEWEST_SEGMENTS or np.ptp(motion) <= AT_REST * np.ptp(window):
        return None
    ranges = np.array([float(np.ptp(part)) for part in np.array_split(motion, segments)])
    if not (ranges > 0).all():
        return None
    times, log_ranges = (
        (np.arange(segments) - (segments - 1) / 2) * step * len(motion) / segments,
        np.log(ranges),
    )
    rate = float(times @ log_ranges / (times @ times))
    residuals = log_ranges - log_ranges.mean() - rate * times
    error = SAFETY * math.sqrt(float(residuals @ residuals) / (segments - 2) / float(times @ times))
    half_periods = np.diff(
        step * (crossings + motion[crossings] / (motion[crossings] - motion[crossings + 1]))
    )
    frequency = float(1 / (2 * half_periods.mean()))
    frequency_error = (
        SAFETY * frequency * float(half_periods.std() / half_periods.mean()) / math.sqrt(len(half_periods))
    )
    return _Rate(rate, error, (channel, frequency, frequency_error), _is_drifting(window))


def _detrended(window: Floats) -> Floats:
    """Return samples (rows, …) less their least-squares lines."""
    times = np.linspace(-1, 1, len(window))
    rows = window.reshape(len(window), -1)
    rows = rows - rows.mean(axis=0)
    rows = rows - times[:, None] * (times @ rows / (times @ times))
    return np.asarray(rows.reshape(window.shape))


def _is_drifting(window: Floats) -> bool:
    """Return whether the quarter means of a channel move in one direction by steps of similar size.

    The last step must also be a large share of the range of the last quarter: an oscillation is no drift.
    """
    quarters = np.array_split(window, 4)
    steps = np.diff([part.mean(axis=0) for part in quarters], axis=0)
    one_direction = (np.sign(steps) == np.sign(steps[0])).all(axis=0)
    sustained = np.abs(steps[2]) > KEPT_SHARE * np.abs(steps[0])
    large = np.abs(steps[2]) > np.maximum(RAMP * np.ptp(window, axis=0), STEADY * np.ptp(quarters[3], axis=0))
    return bool((one_direction & sustained & large).any())
