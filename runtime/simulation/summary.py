"""Summary of a simulated motion: verdict, settling time, frequency, extremes.

Takes: the rows of a simulation, block by block. Gives: `SummaryAccumulator`, `Summary`, `SignalRange`,
`Broken`; `checked_by_analysis`.
Guarantees: the memory used does not grow with the duration.
Does not: prove anything: a verdict holds for the simulated duration (see `analysis` for proofs).

The verdict is one of the following. The rates are those of `decay.fit_motion` over the last half of the
visible motion.

    at rest         no position changes
    decays          the slowest exponential decays, its error included, or every position has settled
    oscillates      an oscillation neither decays nor grows, to within the error of its rate
    diverges        an exponential grows, its error included, or a number leaves the range of floats
    drifts          a position moves on at a constant velocity or acceleration
    driven          a force or another equation changes with time until the end
    not determined  no position was recorded, or the duration is too short to decide

The settling time of a position is the time of its last sample outside `BAND` of its range (highest less
lowest value) around its last value; that of a motion is the largest of its positions. It is None if it is in
the last tenth of the duration. A position has none if its range is rounding compared with those of its unit.
An angle is a position, too.

Without forces that change with time the verdict of a linear topology is consistent with that of `analyze`:
where the two contradict each other (a mode that the motion does not excite, a duration too short) it is "not
determined" (see `checked_by_analysis`).

The work of a coupler is ∫ −f v dt over its held forces, f the force on the coupler at each of its flanges and
v the velocity of the flange: exact, as f is constant between events. Positive work adds energy to the motion.

Limits are those of a device's force and workspace, and other declared limits; they are evaluated in every row
of the recorded signals. Equations can enforce them (`limits: on` of a device).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, analyze
from apc.compiler.compiled import ANGLES, LENGTH, Group, Model
from apc.compiler.errors import ApcError
from apc.lifting.numeric_model import numeric_model
from apc.linearization.jacobians import jacobians
from apc.network.nominal_criterion import unreliable
from apc.simulation.decay import Fit, fit_motion
from apc.simulation.driven import driven_until
from apc.simulation.motion_classes import MotionVerdict
from apc.simulation.output_blocks import OutputBlock
from apc.simulation.signals import Signal
from apc.simulation.simulation import Simulation
from apc.verdict import StabilityVerdict

Floats = NDArray[np.float64]

BAND = 0.05  # of the range: the 5 % settling time of control engineering
LATE = 0.9  # of the duration: a later settling time is not reported, as the motion may not be settled
LEAST_STEP = 0.2  # of the range: least difference from first to last value for an overshoot
POSITIONS = (LENGTH, *ANGLES)  # the units that decide the verdict
ROUNDING = 1e-9  # of the largest range in its unit: a position of smaller range has no settling time
MOST_EXTREMES = 2**22  # numbers stored in each of three tables: 32 MiB
FEWEST_GROUPS = 16  # least number of groups of rows, each with common extremes
MOST_FITTED = 1024  # positions whose last rows are stored for a fit
CHANGED = "peers join or leave in the last tenth of the duration"
SHORT = "the duration is too short, or the motion too irregular, to fit a decay rate"
CONTRADICTION = "the motion within this duration differs from the verdict of the linear topology"
MOST_LINEAR = 60  # peers of a linear model up to which the verdict is compared with an analysis


@dataclass(frozen=True, slots=True)
class Broken:
    """An exceeded limit: `signal`, name of the `limit` and its `value` in SI, with the `unit`.

    `first_s` is the first instant above the limit in seconds; `most` is the largest magnitude, at `at_s`.
    """

    signal: str
    limit: str
    value: float
    unit: str
    first_s: float
    most: float
    at_s: float


@dataclass(frozen=True, slots=True)
class SignalRange:
    """First, last, lowest and highest value of a signal in SI.

    `settled` is its settling time in s or None.
    """

    name: str
    unit: str
    first: float
    last: float
    low: float
    high: float
    settled: float | None


@dataclass(frozen=True, slots=True)
class Summary:
    """A summary of a simulation, in SI units.

    `verdict` is one of those above; `reason` is given if it is not determined. `settled` is the settling time
    in s, at most `settled_error` too large. `fit` is that of the last part of the motion, `oscillating` the
    name of the oscillating position. `driven_until` is the last time in s at which an equation changed with
    time alone. `overshoot` is relative to the step from first to last value. `copies` are (name, distance at
    the end) of states sent unchanged. `work` is (part, J). `broken` are the exceeded limits of recorded
    signals, in order of time. `unrecorded` is the number of positions that were not recorded.
    """

    verdict: MotionVerdict
    reason: str
    settled: float | None
    settled_error: float
    fit: Fit | None
    oscillating: str
    driven_until: float
    stopped: str
    stopped_at: float | None
    overshoot: tuple[str, float] | None
    largest_force: tuple[str, float, float] | None
    copies: tuple[tuple[str, float], ...]
    work: tuple[tuple[str, float], ...]
    rows: int
    signals: int
    end: float
    extents: tuple[SignalRange, ...]
    broken: tuple[Broken, ...] = ()
    unrecorded: int = 0


class SummaryAccumulator:
    """Evaluates the rows of a simulation block by block, storing extremes over groups of rows."""

    def __init__(self, simulation: Simulation, until: float | None = None) -> None:
        """Set up the tables before the first row.

        Parameters
        ----------
        simulation
            The simulation.
        until
            The result of `driven_until`, if it is already computed.
        """
        self.simulation, self.signals = simulation, simulation.signals
        self.until = driven_until(simulation) if until is None else until
        n = len(self.signals)
        # The last instant in s of a join or leave, and the signals of peers that are present at the end.
        self.changed, self.present = 0.0, np.ones(n, np.bool_)
        if simulation.presence is not None:
            end = np.array([int(simulation.settings.duration / simulation.quantum)])
            self.present = simulation.presence.of(self.signals, end)[0]
            changes = simulation.presence.changes(int(end[0])).tolist()
            self.changed = float(max(changes, default=0) * simulation.quantum)
        self.positions = [
            i for i, signal in enumerate(self.signals) if is_position(signal) and self.present[i]
        ]
        self.forces = [
            i for i, signal in enumerate(self.signals) if signal.unit == "N" and signal.role != "limited"
        ]
        self.limits = _limits(simulation.model, self.signals)
        self.width = -(-simulation.rows // max(FEWEST_GROUPS, MOST_EXTREMES // max(n, 1)))
        groups = -(-simulation.rows // self.width)
        self.low, self.high = np.full((groups, n), np.inf), np.full((groups, n), -np.inf)
        self.ends = np.zeros(groups)
        self.fitted = self.positions[:: -(-len(self.positions) // MOST_FITTED) or 1]
        stored = min(simulation.rows, MOST_EXTREMES // max(len(self.fitted), 1))
        self.samples, self.instants = np.zeros((stored, len(self.fitted))), np.zeros(stored)
        self.first, self.last = np.full(n, np.nan), np.full(n, np.nan)
        self.peak, self.peak_at = np.full(n, -1.0), np.zeros(n)
        self.beyond = np.full(len(self.limits), np.nan)
        self.rows = 0

    def take(self, time: Floats, values: Floats) -> None:
        """Update the extremes by some rows: `time` (rows,), `values` (rows, signals)."""
        if not len(time):
            return
        # A peer that joins or leaves has NaN while it is absent.
        self.first = np.where(np.isnan(self.first), _first_finite(values), self.first)
        last = _first_finite(values[::-1])
        self.last = np.where(np.isnan(last), self.last, last)
        group = (self.rows + np.arange(len(time))) // self.width
        index = (self.rows + np.arange(len(time)))[-len(self.samples) :] % len(self.samples)
        self.samples[index] = values[-len(self.samples) :, self.fitted]
        self.instants[index] = time[-len(self.samples) :]
        self.rows += len(time)
        groups, starts = np.unique(group, return_index=True)
        self.low[groups] = np.fmin(self.low[groups], np.fmin.reduceat(values, starts))
        self.high[groups] = np.fmax(self.high[groups], np.fmax.reduceat(values, starts))
        self.ends[group] = time
        columns = np.array([*self.forces, *(column for column, _, _ in self.limits)], np.int64)
        size = np.nan_to_num(np.abs(values[:, columns]))
        largest = size.max(axis=0)
        increased = largest > self.peak[columns]
        self.peak[columns[increased]] = largest[increased]
        self.peak_at[columns[increased]] = time[size.argmax(axis=0)[increased]]
        exceeds = size[:, len(self.forces) :] > [bound for _, _, bound in self.limits]
        first_exceeded = exceeds.any(axis=0) & np.isnan(self.beyond)
        self.beyond[first_exceeded] = time[exceeds.argmax(axis=0)[first_exceeded]]

    def summary(self, block: OutputBlock) -> Summary:
        """Return the summary of all rows; `block` is the last block."""
        assert self.rows, "a simulation has a row at time 0"
        group_count = (self.rows - 1) // self.width + 1
        low, high, ends = self.low[:group_count], self.high[:group_count], self.ends[:group_count]
        with np.errstate(over="ignore", invalid="ignore"):  # of a diverged motion
            settled = self._settled(low, high, ends)
            fit = self._fit(high.max(axis=0) - low.min(axis=0))
        signals = self.signals
        end_values = np.stack([self.first, self.last, low.min(axis=0), high.max(axis=0)], axis=1).tolist()
        extents = tuple(
            SignalRange(
                signal.name,
                signal.unit,
                first,
                last,
                least,
                most,
                None if np.isnan(settling_time) else settling_time,
            )
            for signal, settling_time, (first, last, least, most) in zip(
                signals, settled.tolist(), end_values, strict=True
            )
        )
        position_ranges = [extents[i] for i in self.positions]
        all_settled = bool(position_ranges) and not np.isnan(settled[self.positions]).any()
        verdict, reason = self._verdict(block, position_ranges, fit, float(ends[-1]), settled=all_settled)
        all_settled &= verdict not in (MotionVerdict.AT_REST, MotionVerdict.DIVERGES, MotionVerdict.DRIVEN)
        largest = max(self.forces, key=lambda i: float(self.peak[i]), default=-1)
        work = tuple(zip(self.simulation.population.parts, block.work.tolist(), strict=True))
        force = None
        if largest >= 0:
            force = signals[largest].name, float(self.peak[largest]), float(self.peak_at[largest])
        row_period = float(ends[-1] - ends[-2]) / self.width if group_count > 2 and self.width > 1 else 0.0
        oscillating = signals[self.fitted[fit.oscillation.index]].name if fit and fit.oscillation else ""
        return Summary(
            verdict=verdict,
            reason=reason,
            settled=float(settled[self.positions].max()) if all_settled else None,
            settled_error=row_period * (self.width - 1),
            fit=fit,
            oscillating=oscillating,
            driven_until=self.until,
            stopped=block.stopped,
            stopped_at=block.stopped_at if block.stopped else None,
            overshoot=_overshoot(position_ranges) if all_settled else None,
            largest_force=force,
            copies=self._copies(),
            # The work of an unbounded motion is meaningless.
            work=() if block.stopped else work,
            rows=self.rows,
            signals=len(signals),
            end=float(ends[-1]),
            extents=extents,
            broken=self._broken(),
            unrecorded=_position_count(self.simulation.model) - sum(map(is_position, self.signals)),
        )

    def _verdict(
        self,
        block: OutputBlock,
        position_ranges: Sequence[SignalRange],
        fit: Fit | None,
        end: float,
        *,
        settled: bool,
    ) -> tuple[MotionVerdict, str]:
        """Return the verdict, and the reason if it is not determined."""
        if block.stopped:
            return MotionVerdict.DIVERGES, ""
        if not position_ranges:
            return MotionVerdict.NOT_DETERMINED, "no position was recorded"
        if self.until > LATE * end:
            return MotionVerdict.DRIVEN, ""
        if self.changed > LATE * end:
            return MotionVerdict.NOT_DETERMINED, CHANGED
        if all(extent.low == extent.high for extent in position_ranges):
            return MotionVerdict.AT_REST, ""
        if fit is None:
            return (MotionVerdict.DECAYS, "") if settled else (MotionVerdict.NOT_DETERMINED, SHORT)
        if fit.grows and not fit.ended:
            return MotionVerdict.DIVERGES, ""
        if fit.ramp and not fit.ended:  # larger than any oscillation about it
            return MotionVerdict.DRIFTS, ""
        if fit.lasts and not fit.ended:
            return MotionVerdict.OSCILLATES, ""
        if fit.decays or fit.ended or settled:
            return MotionVerdict.DECAYS, ""
        return MotionVerdict.NOT_DETERMINED, SHORT

    def _settled(self, low: Floats, high: Floats, ends: Floats) -> Floats:
        """Return the settling time of each signal in s, NaN if it is later than LATE of the duration."""
        span = high.max(axis=0) - low.min(axis=0)
        units = np.array([signal.unit for signal in self.signals])
        least = np.zeros(len(span))
        for unit in dict.fromkeys(units.tolist()):
            least[units == unit] = ROUNDING * span[units == unit].max()
        band = np.where(span > least, BAND * span, np.inf)
        outside = (high - self.last > band) | (self.last - low > band)
        first_settled_group = np.where(outside.any(axis=0), len(outside) - outside[::-1].argmax(axis=0), 0)
        settling_times = np.append(0.0, ends)[first_settled_group]
        return np.where(settling_times <= LATE * ends[-1], settling_times, np.nan)

    def _fit(self, span: Floats) -> Fit | None:
        """Return the fit of the stored rows after `until`, None without rows or positions."""
        stored = np.arange(max(self.rows - len(self.samples), 0), self.rows) % len(self.samples)
        stored = stored[self.instants[stored] >= max(self.until, self.changed)]
        if len(stored) < 2 or not self.fitted:
            return None
        # Lengths are compared with lengths, angles with angles.
        units = np.array([self.signals[i].unit for i in self.fitted])
        scale = np.zeros(len(self.fitted))
        for unit in dict.fromkeys(units.tolist()):
            scale[units == unit] = span[self.fitted][units == unit].max()
        step = float(self.instants[stored[-1]] - self.instants[stored[0]]) / (len(stored) - 1)
        return fit_motion(step, self.samples[stored], scale)

    def _copies(self) -> tuple[tuple[str, float], ...]:
        """Return the final distance between the peers' copies of each state that is sent unchanged."""
        copies = []
        for name in self.simulation.sent:
            indices = [
                i
                for i, signal in enumerate(self.signals)
                if signal.local == name and signal.unit in POSITIONS and self.present[i]
            ]
            if len(indices) > 1:
                copies.append((name, float(np.ptp(self.last[indices]))))
        return tuple(copies)

    def _broken(self) -> tuple[Broken, ...]:
        """Return the exceeded limits, in order of time."""
        broken = [
            Broken(
                self.signals[column].name,
                name,
                bound,
                self.signals[column].unit,
                float(first),
                float(self.peak[column]),
                float(self.peak_at[column]),
            )
            for (column, name, bound), first in zip(self.limits, self.beyond, strict=True)
            if not np.isnan(first)
        ]
        return tuple(sorted(broken, key=lambda limit: limit.first_s))


def _first_finite(values: Floats) -> Floats:
    """Return the first finite value of each column (rows, n), NaN where there is none."""
    rows: Floats = values[np.isfinite(values).argmax(axis=0), np.arange(values.shape[1])]
    return rows


def _limits(model: Model, signals: Sequence[Signal]) -> list[tuple[int, str, float]]:
    """Return the column, the name and the value of each signal's limit.

    Values may differ from peer to peer.
    """
    groups = {group.name: group for group in model.groups}
    common = {parameter.name: parameter.value for parameter in model.parameters}
    limits = {
        (group.name, limit.name): limit.limit
        for group in model.groups
        for limit in model.peer_types[group.peer_type].limits
    }
    return [
        (column, name, _parameter_of_peer(groups[signal.group], signal.peer, name, common))
        for column, signal in enumerate(signals)
        if (name := limits.get((signal.group, signal.local))) is not None
    ]


def _parameter_of_peer(group: Group, peer: int, name: str, common: dict[str, float]) -> float:
    """Return a parameter's value at one peer, counted from 1: of the peer, of its group, or of the model."""
    for column in group.columns:
        if column.name == name:
            return float(column.values[peer - 1])
    return next((value.value for value in group.values if value.name == name), common[name])


def checked_by_analysis(summary: Summary, model: Model) -> Summary:
    """Return a summary whose verdict is "not determined" if it contradicts the analysis of a linear model.

    Parameters
    ----------
    summary
        The summary of a motion by exact transitions.
    model
        The simulated model.
    """
    driven = summary.verdict is MotionVerdict.DRIVEN
    if (
        summary.verdict is MotionVerdict.AT_REST
        or (summary.driven_until and not driven)
        or model.peers > MOST_LINEAR
    ):
        return summary
    if not all(jacobians(peer_type).affine for peer_type in model.peer_types) or unreliable(model):
        return summary
    try:
        analysis = analyze(numeric_model(model))
    except ApcError:  # models that cannot be analyzed can be simulated
        return summary
    if driven:
        if analysis.stable is not False or analysis.verdict is StabilityVerdict.DRIFTS:
            return summary
        reason = f"driven; apc analyze: {analysis.verdict}{_time_constant(analysis)}"
        return replace(summary, verdict=MotionVerdict.DIVERGES, reason=reason)
    decays, decays_or_drifts = (
        summary.verdict is MotionVerdict.DECAYS,
        summary.verdict in (MotionVerdict.DECAYS, MotionVerdict.DRIFTS),
    )
    drifts = analysis.verdict is StabilityVerdict.DRIFTS
    contradicted = {
        True: not decays_or_drifts
        or (summary.verdict is MotionVerdict.DRIFTS and analysis.verdict is StabilityVerdict.STABLE),
        False: decays or (summary.verdict is not MotionVerdict.DIVERGES and not drifts),
        None: False,
    }[analysis.stable]
    if not contradicted:
        return summary
    reason = f"{summary.reason or CONTRADICTION}; apc analyze: {analysis.verdict}{_time_constant(analysis)}"
    return replace(summary, verdict=MotionVerdict.NOT_DETERMINED, reason=reason)


def _time_constant(analysis: Analysis) -> str:
    """Return the time constant of the slowest decay or fastest growth as text, "" if there is none."""
    if not 0 < analysis.spectral_radius != 1:
        return ""
    slowest = analysis.frame_s / abs(math.log(analysis.spectral_radius))
    return f", {'decay' if analysis.spectral_radius < 1 else 'growth'} time constant {slowest:.6g} s"


def is_position(signal: Signal) -> bool:
    """Return whether a signal is a position: the verdict depends on positions only."""
    return signal.role == "state" and signal.unit in POSITIONS


def _position_count(model: Model) -> int:
    """Return the number of positions in a model, over all peers."""
    per_type = [sum(state.unit in POSITIONS for state in peer_type.states) for peer_type in model.peer_types]
    return sum(group.count * per_type[group.peer_type] for group in model.groups)


def _overshoot(extents: Sequence[SignalRange]) -> tuple[str, float] | None:
    """Return the position with the largest overshoot, relative to the step from first to last value.

    It is None if no position has a sufficient step.
    """
    overshoots = []
    for extent in extents:
        step = extent.last - extent.first
        if step and abs(step) > LEAST_STEP * (extent.high - extent.low):
            excess = extent.high - extent.last if step > 0 else extent.last - extent.low
            overshoots.append((extent.name, excess / abs(step)))
    return max(overshoots, key=lambda pair: pair[1], default=None)
