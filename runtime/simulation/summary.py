"""Summary of a simulated motion: verdict, settling time, frequency, extremes.

Takes: the rows of a simulation, as they come. Gives: `SummaryAccumulator`, `Summary`, `SignalRange`,
`Broken`; `agreed`.
Guarantees: the memory used does not grow with the duration.
Does not: prove anything: a verdict holds for the duration that was simulated (see `analysis` for proof).

The verdict is one of these. The rates are those of `decay.fit_motion`, of the last half of the motion that is
visible.

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
determined" (see `agreed`).

The work a coupler does is ∫ −f v dt over the forces it holds, f the flow into the coupler at each of its
flanges and v that flange's velocity: exact, as f is constant between events. Positive work feeds the motion.

A limit is of a device's force and reach, and of whatever else declares one; it is evaluated in every row of
what is recorded. To keep a motion within it is for equations (`limits: on` of a device).
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
from apc.frame.jacobians import jacobians
from apc.network.nominal_criterion import unreliable
from apc.simulation.decay import Fit, fit_motion
from apc.simulation.driven import driven_until
from apc.simulation.motion_classes import MotionVerdict
from apc.simulation.output_blocks import OutputBlock
from apc.simulation.signals import Signal
from apc.simulation.simulation import Simulation
from apc.verdict import StabilityVerdict

Floats = NDArray[np.float64]

BAND = 0.05  # of the range: the 5 % of control engineering's settling time
LATE = 0.9  # of the duration: a settling time after that may be of the duration, not of the motion
LEAST_STEP = 0.2  # of the range: a smaller difference from first to last value is no step to overshoot
POSITIONS = (LENGTH, *ANGLES)  # the units that decide the verdict
ROUNDING = 1e-9  # of the largest range of its unit: a position that moves by less has no settling time
MOST_EXTREMES = 2**22  # numbers kept for each of three tables: 32 MiB
FEWEST_GROUPS = 16  # of rows whose extremes are kept together, whatever their number
MOST_FITTED = 1024  # positions whose last rows are kept for a fit
SHORT = "the duration is too short, or the motion too irregular, for a decay rate"
CONTRADICTION = "the motion within this duration does not show the verdict of the linear topology"
MOST_LINEAR = 60  # peers of a linear topology that is analyzed together with a motion


@dataclass(frozen=True, slots=True)
class Broken:
    """A limit that was broken: the `signal`, its `limit` by name and `value`, in SI, with its `unit`.

    It is beyond it from `first_s` seconds on; its largest size is `most`, at `at_s` seconds.
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
    """First, last, lowest and highest value of a signal in SI; `settled` is its settling time or None."""

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

    `verdict` is one of those above; `reason` is why it is not determined. `settled` is the settling time in
    s, at most `settled_error` too large. `fit` is that of the last part of the motion, `oscillating` the name
    of the position of its oscillation. `driven_until` is the last time in s at which an equation changed with
    time alone. `overshoot` is a part of the step from first to last. `copies` are (name, distance at the end)
    of states sent unchanged. `work` is (part, J). `broken` are the exceeded limits of recorded signals, in
    order of time. `unrecorded` positions of the model were not evaluated.
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
    """Evaluates a simulation's rows as they pass and keeps extremes, group by group of rows."""

    def __init__(self, simulation: Simulation, until: float | None = None) -> None:
        """Initialize before the first simulated row.

        Parameters
        ----------
        simulation
            The simulation.
        until
            Its `driven_until`, if that is known already.
        """
        self.simulation, self.signals = simulation, simulation.signals
        self.until = driven_until(simulation) if until is None else until
        n = len(self.signals)
        self.positions = [i for i, signal in enumerate(self.signals) if is_position(signal)]
        self.forces = [
            i for i, signal in enumerate(self.signals) if signal.unit == "N" and signal.role != "limited"
        ]
        self.limits = _limits(simulation.system, self.signals)
        self.width = -(-simulation.rows // max(FEWEST_GROUPS, MOST_EXTREMES // max(n, 1)))
        groups = -(-simulation.rows // self.width)
        self.low, self.high = np.full((groups, n), np.inf), np.full((groups, n), -np.inf)
        self.ends = np.zeros(groups)
        self.fitted = self.positions[:: -(-len(self.positions) // MOST_FITTED) or 1]
        stored = min(simulation.rows, MOST_EXTREMES // max(len(self.fitted), 1))
        self.samples, self.instants = np.zeros((stored, len(self.fitted))), np.zeros(stored)
        self.first, self.last = np.zeros(n), np.zeros(n)
        self.peak, self.peak_at = np.full(n, -1.0), np.zeros(n)
        self.beyond = np.full(len(self.limits), np.nan)
        self.rows = 0

    def take(self, time: Floats, values: Floats) -> None:
        """Evaluate some rows: `time` (rows,), `values` (rows, signals)."""
        if not len(time):
            return
        if not self.rows:
            self.first = values[0].copy()
        self.last = values[-1].copy()
        group = (self.rows + np.arange(len(time))) // self.width
        index = (self.rows + np.arange(len(time)))[-len(self.samples) :] % len(self.samples)
        self.samples[index] = values[-len(self.samples) :, self.fitted]
        self.instants[index] = time[-len(self.samples) :]
        self.rows += len(time)
        touched, starts = np.unique(group, return_index=True)
        self.low[touched] = np.minimum(self.low[touched], np.minimum.reduceat(values, starts))
        self.high[touched] = np.maximum(self.high[touched], np.maximum.reduceat(values, starts))
        self.ends[group] = time
        watched = np.array([*self.forces, *(column for column, _, _ in self.limits)], np.int64)
        size = np.abs(values[:, watched])
        largest = size.max(axis=0)
        grown = largest > self.peak[watched]
        self.peak[watched[grown]] = largest[grown]
        self.peak_at[watched[grown]] = time[size.argmax(axis=0)[grown]]
        over = size[:, len(self.forces) :] > [bound for _, _, bound in self.limits]
        began = over.any(axis=0) & np.isnan(self.beyond)
        self.beyond[began] = time[over.argmax(axis=0)[began]]

    def summary(self, block: OutputBlock) -> Summary:
        """Return the summary of the rows; `block` is the last."""
        assert self.rows, "a simulation has a row at time 0"
        number = (self.rows - 1) // self.width + 1
        low, high, ends = self.low[:number], self.high[:number], self.ends[:number]
        with np.errstate(over="ignore", invalid="ignore"):  # of what has diverged
            settled = self._settled(low, high, ends)
            fit = self._fit(high.max(axis=0) - low.min(axis=0), float(ends[-1]))
        signals = self.signals
        numbers = np.stack([self.first, self.last, low.min(axis=0), high.max(axis=0)], axis=1).tolist()
        extents = tuple(
            SignalRange(
                signal.name, signal.unit, first, last, least, most, None if np.isnan(since) else since
            )
            for signal, since, (first, last, least, most) in zip(
                signals, settled.tolist(), numbers, strict=True
            )
        )
        moved = [extents[i] for i in self.positions]
        all_settled = bool(moved) and not np.isnan(settled[self.positions]).any()
        verdict, reason = self._verdict(block, moved, fit, float(ends[-1]), settled=all_settled)
        all_settled &= verdict not in (MotionVerdict.AT_REST, MotionVerdict.DIVERGES, MotionVerdict.DRIVEN)
        largest = max(self.forces, key=lambda i: float(self.peak[i]), default=-1)
        work = tuple(zip(self.simulation.population.parts, block.work.tolist(), strict=True))
        force = None
        if largest >= 0:
            force = signals[largest].name, float(self.peak[largest]), float(self.peak_at[largest])
        row = float(ends[-1] - ends[-2]) / self.width if number > 2 and self.width > 1 else 0.0
        oscillating = signals[self.fitted[fit.oscillation.index]].name if fit and fit.oscillation else ""
        return Summary(
            verdict=verdict,
            reason=reason,
            settled=float(settled[self.positions].max()) if all_settled else None,
            settled_error=row * (self.width - 1),
            fit=fit,
            oscillating=oscillating,
            driven_until=self.until,
            stopped=block.stopped,
            stopped_at=block.stopped_at if block.stopped else None,
            overshoot=_overshoot(moved) if all_settled else None,
            largest_force=force,
            copies=self._copies(),
            # The work of an unbounded motion is meaningless.
            work=() if block.stopped else work,
            rows=self.rows,
            signals=len(signals),
            end=float(ends[-1]),
            extents=extents,
            broken=self._broken(),
            unrecorded=_positions(self.simulation.system) - len(self.positions),
        )

    def _verdict(
        self, block: OutputBlock, moved: Sequence[SignalRange], fit: Fit | None, end: float, *, settled: bool
    ) -> tuple[MotionVerdict, str]:
        """Return the verdict, and why it is not determined."""
        if block.stopped:
            return MotionVerdict.DIVERGES, ""
        if not moved:
            return MotionVerdict.NOT_DETERMINED, "no position was recorded"
        if self.until > LATE * end:
            return MotionVerdict.DRIVEN, ""
        if all(extent.low == extent.high for extent in moved):
            return MotionVerdict.AT_REST, ""
        if fit is None:
            return (MotionVerdict.DECAYS, "") if settled else (MotionVerdict.NOT_DETERMINED, SHORT)
        if fit.grows and not fit.ended:
            return MotionVerdict.DIVERGES, ""
        if fit.lasts and not fit.ended:
            return MotionVerdict.OSCILLATES, ""
        if fit.ramp and not fit.ended:
            return MotionVerdict.DRIFTS, ""
        if fit.decays or fit.ended or settled:
            return MotionVerdict.DECAYS, ""
        return MotionVerdict.NOT_DETERMINED, SHORT

    def _settled(self, low: Floats, high: Floats, ends: Floats) -> Floats:
        """Return the settling time of each signal; NaN if that is too near to the end."""
        span = high.max(axis=0) - low.min(axis=0)
        units = np.array([signal.unit for signal in self.signals])
        least = np.zeros(len(span))
        for unit in dict.fromkeys(units.tolist()):
            least[units == unit] = ROUNDING * span[units == unit].max()
        band = np.where(span > least, BAND * span, np.inf)
        outside = (high - self.last > band) | (self.last - low > band)
        after = np.where(outside.any(axis=0), len(outside) - outside[::-1].argmax(axis=0), 0)
        since = np.append(0.0, ends)[after]
        return np.where(since <= LATE * ends[-1], since, np.nan)

    def _fit(self, span: Floats, end: float) -> Fit | None:
        """Return the fit of the rows kept after the last change with time, None where there is none."""
        stored = np.arange(max(self.rows - len(self.samples), 0), self.rows) % len(self.samples)
        stored = stored[self.instants[stored] >= self.until]
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
                if signal.local == name and signal.unit in POSITIONS
            ]
            if len(indices) > 1:
                copies.append((name, float(np.ptp(self.last[indices]))))
        return tuple(copies)

    def _broken(self) -> tuple[Broken, ...]:
        """Return the limits that were broken, the first of them first."""
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


def _limits(system: Model, signals: Sequence[Signal]) -> list[tuple[int, str, float]]:
    """Return the columns of signals that have a limit, its name and its value, those of each peer its own."""
    groups = {group.name: group for group in system.groups}
    common = {parameter.name: parameter.value for parameter in system.parameters}
    limits = {
        (group.name, limit.name): limit.limit
        for group in system.groups
        for limit in system.peer_types[group.peer_type].limits
    }
    return [
        (column, name, _number(groups[signal.group], signal.peer, name, common))
        for column, signal in enumerate(signals)
        if (name := limits.get((signal.group, signal.local))) is not None
    ]


def _number(group: Group, peer: int, name: str, common: dict[str, float]) -> float:
    """Return a number of one peer, counted from 1: its own, its group's, or that of all."""
    for column in group.columns:
        if column.name == name:
            return float(column.values[peer - 1])
    return next((value.value for value in group.values if value.name == name), common[name])


def agreed(summary: Summary, system: Model) -> Summary:
    """Return the summary of a motion, not determined where it contradicts the analysis of a linear topology.

    Parameters
    ----------
    summary
        That of a motion by exact transitions.
    system
        The topology that was simulated.
    """
    driven = summary.verdict is MotionVerdict.DRIVEN
    if (
        summary.verdict is MotionVerdict.AT_REST
        or (summary.driven_until and not driven)
        or system.peers > MOST_LINEAR
    ):
        return summary
    if not all(jacobians(peer_type).affine for peer_type in system.peer_types) or unreliable(system):
        return summary
    try:
        analysis = analyze(system)
    except ApcError:  # models that cannot be analyzed can be simulated
        return summary
    if driven:
        if analysis.stable is not False or analysis.verdict is StabilityVerdict.DRIFTS:
            return summary
        reason = f"driven; apc analyze: {analysis.verdict}{_time_constant(analysis)}"
        return replace(summary, verdict=MotionVerdict.DIVERGES, reason=reason)
    decays, lasts = (
        summary.verdict is MotionVerdict.DECAYS,
        summary.verdict in (MotionVerdict.DECAYS, MotionVerdict.DRIFTS),
    )
    drifts = analysis.verdict is StabilityVerdict.DRIFTS
    contradicted = {
        True: not lasts
        or (summary.verdict is MotionVerdict.DRIFTS and analysis.verdict is StabilityVerdict.STABLE),
        False: decays or (summary.verdict is not MotionVerdict.DIVERGES and not drifts),
        None: False,
    }[analysis.stable]
    if not contradicted:
        return summary
    reason = f"{summary.reason or CONTRADICTION}; apc analyze: {analysis.verdict}{_time_constant(analysis)}"
    return replace(summary, verdict=MotionVerdict.NOT_DETERMINED, reason=reason)


def _time_constant(analysis: Analysis) -> str:
    """Return the time constant of the slowest decay or fastest growth in words, "" where there is none."""
    if not 0 < analysis.spectral_radius != 1:
        return ""
    slowest = analysis.frame_s / abs(math.log(analysis.spectral_radius))
    return f", {'decay' if analysis.spectral_radius < 1 else 'growth'} time constant {slowest:.6g} s"


def is_position(signal: Signal) -> bool:
    """Return whether a signal is a position, which decides the verdict."""
    return signal.role == "state" and signal.unit in POSITIONS


def _positions(system: Model) -> int:
    """Return the number of positions in a model."""
    each = [sum(state.unit in POSITIONS for state in peer_type.states) for peer_type in system.peer_types]
    return sum(group.count * each[group.peer_type] for group in system.groups)


def _overshoot(extents: Sequence[SignalRange]) -> tuple[str, float] | None:
    """Return the largest excess over the last value, as a part of the step from the first."""
    beyonds = []
    for extent in extents:
        step = extent.last - extent.first
        if step and abs(step) > LEAST_STEP * (extent.high - extent.low):
            beyond = extent.high - extent.last if step > 0 else extent.last - extent.low
            beyonds.append((extent.name, beyond / abs(step)))
    return max(beyonds, key=lambda pair: pair[1], default=None)
