"""Error estimate of a simulation by comparison with a more accurate second run.

Takes: a `Simulation`.
Gives: `AccuracyEstimator`, `SignalError`, `ErrorEstimate`, `compare_with`.
Guarantees: the two runs receive the same packets; the memory used does not grow with the duration.
Does not: prove a bound: if the motion is unstable, or contacts open and close, the two runs diverge, and the
estimate becomes large.

By CVODES the second run has tolerances 100 times tighter. With a fixed step it has half the step, and the
error is the difference times 1/(1 − 1/2ⁿ) for a method of order n. An exact transition has rounding errors
only: the second run changes every coefficient of the transitions by one unit in the last place, and the
difference estimates the effect of rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from apc.simulation.output_blocks import OutputBlock, blocks
from apc.simulation.settings import finer
from apc.simulation.signals import Signal
from apc.simulation.simulation import Simulation, prepare


@dataclass(frozen=True, slots=True)
class SignalError:
    """The largest error of a signal in SI, at the time `at` in s.

    `relative` is its ratio to the range `span`.
    """

    name: str
    unit: str
    error: float
    at: float
    span: float

    @property
    def relative(self) -> float:
        """The error divided by the range of the signal; 0 for a constant signal."""
        return self.error / self.span if self.span else 0.0


@dataclass(frozen=True, slots=True)
class ErrorEstimate:
    """The estimated errors by signal.

    `kind` is "rounding" or "method", `compared` describes the reference run.
    """

    kind: str
    compared: str
    signals: tuple[SignalError, ...]

    @property
    def largest(self) -> SignalError | None:
        """The signal with the largest error relative to its range."""
        return max(self.signals, key=lambda signal: signal.relative, default=None)


class AccuracyEstimator:
    """Compares the blocks of a run with those of a more accurate run, simulated at the same time."""

    def __init__(self, closer: Simulation, kind: str, compared: str, factor: float) -> None:
        self.kind, self.compared, self.factor = kind, compared, factor
        self.signals: tuple[Signal, ...] = closer.signals
        self.blocks = blocks(closer)
        n = len(self.signals)
        self.error, self.at = np.zeros(n), np.zeros(n)
        self.low, self.high = np.full(n, np.inf), np.full(n, -np.inf)

    def take(self, block: OutputBlock) -> None:
        """Update the errors by one block; rows that only one of the runs reaches are left out."""
        reference = next(self.blocks, None)
        rows = min(len(block.time), len(reference.time)) if reference else 0
        if not reference or not rows:
            return
        values = block.values[:rows]
        errors = self.factor * np.nan_to_num(np.abs(values - reference.values[:rows]))  # 0 at absent peers
        larger = errors.max(axis=0) > self.error
        self.at[larger] = block.time[errors.argmax(axis=0)[larger]]
        self.error = np.maximum(self.error, errors.max(axis=0))
        self.low, self.high = (
            np.fmin(self.low, np.fmin.reduce(values)),
            np.fmax(self.high, np.fmax.reduce(values)),
        )

    def estimate(self) -> ErrorEstimate:
        """Return the error estimate over the blocks until now."""
        span = np.where(self.high >= self.low, self.high - self.low, 0.0)
        columns: Sequence[Any] = (self.error.tolist(), self.at.tolist(), span.tolist())
        estimates = (
            SignalError(signal.name, signal.unit, *numbers)
            for signal, *numbers in zip(self.signals, *columns, strict=True)
        )
        return ErrorEstimate(self.kind, self.compared, tuple(estimates))


def compare_with(simulation: Simulation, *, signals: Sequence[str] = ()) -> AccuracyEstimator:
    """Return the estimator of a simulation's error, with the more accurate run prepared.

    Parameters
    ----------
    simulation
        The simulation.
    signals
        The patterns of the recorded signals, as for `prepare`.
    """
    method, factor = finer(simulation.settings.method, all_linear=not simulation.tolerances)
    closer = prepare(simulation.model, replace(simulation.settings, method=method), signals=signals)
    if method.perturbed:
        return AccuracyEstimator(closer, "rounding", "coefficients off by one rounding", factor)
    if method.step is not None:
        return AccuracyEstimator(closer, "method", f"half the step, {method}", factor)
    return AccuracyEstimator(closer, "method", f"tolerance {method.tolerance:g}", factor)
