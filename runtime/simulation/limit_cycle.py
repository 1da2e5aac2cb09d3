"""Limit cycles of one-sided contacts: describing-function prediction and simulation.

Takes: a `Model` whose peers have one-sided contacts.
Gives: `SpectralPeak`, `ContactLimitCycle`, `LimitCycle`, `limit_cycle`.
Guarantees: a prediction is always returned with the simulated result. More than one spectral line is
reported.
Does not: find every limit cycle: it simulates one start, that of the model.

The static loads of the prediction are the mean forces of the simulated motion.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy.signal import find_peaks

from apc.analysis.describing_function import Predicted, predict
from apc.analysis.lure_form import contact_groups
from apc.analysis.sector_nonlinearity import SectorNonlinearity
from apc.compiler.compiled import LENGTH, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.eigen.peer_classes import PeerClass
from apc.frame.communication_graph import build_exchange
from apc.frame.numeric_model import Prepared, prepare
from apc.frame.parameters import resolve
from apc.not_supported import NotSupportedError
from apc.result import Result
from apc.simulation.trajectory import Trajectory, simulate

Floats = NDArray[np.float64]

# The duration of the simulation, in seconds: the least for many peers, the most for few; and its last part,
# which is measured.
SHORTEST, LONGEST, MEASURED = 8, 80, 4

# Below this fraction of time a contact counts as open; beyond this relative difference frequencies differ.
TOUCHED, SEPARATE = 1e-3, 0.2

LET_GO = "the loads hold no contact closed: what touched at the start has let go, and there is no buzz"

# Peers whose contacts are measured; ticks of all peers that are simulated, some ten seconds' worth.
MOST_PEERS, MOST_SIMULATED = 20, 2 * 10**7

# A swing below this part of the depth is none. If it changes by more than this over what is measured, it has
# not come to its end.
QUIET, SETTLED = 1e-4, 0.02

# The smallest relative amplitude of a second spectral line; leakage of a steady oscillation is far smaller.
# Of two lines, combination frequencies up to this order, and their multiples, are not counted as a third.
SECOND, MIXED = 0.1, 3

BY_CHANCE = "predicted with every packet on time, played with lost and late ones"

# Spectrum points between two resolvable frequencies.
FINER = 8


@dataclass(frozen=True, slots=True)
class SpectralPeak:
    """A frequency of the depth that swings most, and its amplitude in m."""

    frequency_hz: float
    amplitude_m: float


@dataclass(frozen=True, slots=True)
class ContactLimitCycle:
    """A simulated contact, and its depth as predicted under its load.

    `load_n` is its mean push; `depth_m` is from the least to the largest, `in_contact` the share of the time
    in which it pushes. `predicted_depth_m` is None where nothing is predicted.
    """

    name: str
    load_n: float
    depth_m: float
    in_contact: float
    predicted_depth_m: float | None


@dataclass(frozen=True, slots=True)
class LimitCycle(Result):
    """A limit cycle of contacts, predicted and simulated over `simulated_s` seconds.

    `predicted` is None if `reason` is given. `lines` are those of the spectrum, the largest first, none where
    the motion comes to rest or still changes; `steady` is whether the oscillation is stationary; `bounded`,
    whether the simulation reached its end. `notes` describe the validity of the prediction.
    """

    shown_by = "simulation_output:limit_cycle"

    topology: str
    predicted: Predicted | None
    reason: str
    simulated_s: float
    bounded: bool
    steady: bool
    lines: tuple[SpectralPeak, ...]
    contacts: tuple[ContactLimitCycle, ...]
    notes: tuple[str, ...]

    @property
    def settles(self) -> bool:
        """Whether the simulated motion came to rest, except for rounding."""
        return self.steady and not self.lines


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    """A contact of one peer: the names of the states its depth is of, their factors, and its push."""

    name: str
    states: tuple[str, ...]
    factors: Floats
    offset: float
    stiffness: float


@part("limit cycle")
def limit_cycle(system: Model, *, prepared: Prepared | None = None) -> LimitCycle:
    """Predict the limit cycles of a model's one-sided contacts, and simulate them.

    Parameters
    ----------
    system
        The model, with the parameter values to analyze.
    prepared
        From `numeric_model.prepare`, of this system with these timings.

    Raises
    ------
    ApcError
        E864 no contact that pushes from tick to tick and never pulls; and those of `trajectory.simulate`.
    """
    try:
        groups = contact_groups(system, prepared or prepare(system))
    except NotSupportedError as why:
        raise _refused(system, str(why)) from None
    if not any(pushes for _, pushes in groups):
        raise _refused(system, "nothing touches")
    for _, pushes in groups:
        for push in pushes:
            if not push.unilateral:
                raise _refused(system, f"{push.part} pulls, too, or is limited")
    measured = _contacts(system, groups)
    predicted, reason = None, ""
    try:
        predicted = predict(system, groups)
    except NotSupportedError as why:
        reason = str(why)
    seconds = _seconds(system)
    names = [item.name for item in measured] + [state for item in measured for state in item.states]
    simulated = simulate(system, duration=seconds, signals=tuple(dict.fromkeys(names)))
    result = _compare(system.name, predicted, reason, simulated, measured)
    if all(link.channel is None for link in system.links):
        return result
    return replace(result, notes=(*result.notes, BY_CHANCE))


def _seconds(system: Model) -> Fraction:
    """Return the simulated duration, in whole seconds: `LONGEST`, or less for many peers."""
    timings = {timing.name: timing.value for timing in system.timings}
    tick = min(timings[clock.period] for clock in system.clocks)
    most = math.floor(MOST_SIMULATED * tick / system.peers)
    if most < SHORTEST:
        raise _refused(system, f"{system.peers:,} peers are too many to play for {SHORTEST} s")
    return Fraction(min(most, LONGEST))


def _refused(system: Model, why: str) -> ApcError:
    message = f"no buzz to predict: {why}"
    return ApcError(Diagnostic("E864", SourceLocation(system.origin.topology), message, hint="apc simulate"))


def _contacts(
    system: Model, groups: Sequence[tuple[PeerClass, tuple[SectorNonlinearity, ...]]]
) -> list[_Measured]:
    """Return the contacts that are measured, those of the first peers of each group."""
    exchange = build_exchange(system, resolve(system).timings)
    each = max(1, MOST_PEERS // len(groups))
    result = []
    for group, pushes in groups:
        for peer in itertools.islice(group.peers, each):
            name = exchange.peer_name(peer)
            for push in pushes:
                states = group.jacobians.peer_type.states
                indices = [k for k, state in enumerate(states) if state.unit == LENGTH and push.slopes[k]]
                if push.slopes[push.states :].any() or not indices:
                    raise _refused(system, f"{push.part} follows more than positions and velocities")
                stiffness = float(np.abs(push.slopes[indices]).max())
                result.append(
                    _Measured(
                        f"{name}.{push.part}",
                        tuple(f"{name}.{states[k].name}" for k in indices),
                        push.slopes[indices] / stiffness,
                        push.offset / stiffness,
                        stiffness,
                    )
                )
    return result


def _compare(
    topology: str,
    predicted: Predicted | None,
    reason: str,
    simulated: Trajectory,
    measured: Sequence[_Measured],
) -> LimitCycle:
    """Compare the prediction, or the reason for its absence, with the simulation."""
    first = len(simulated.time) - len(simulated.time) // MEASURED
    bounded = not simulated.summary.stopped
    time = simulated.time[first:]
    depths = [
        item.offset
        + sum(f * simulated[state][first:] for f, state in zip(item.factors, item.states, strict=True))
        for item in measured
    ]
    pushes = [simulated[item.name][first:] for item in measured]
    window = np.hanning(len(time))
    loads = [float(push @ window / window.sum()) for push in pushes]
    contacts = tuple(
        ContactLimitCycle(
            name=item.name,
            load_n=load,
            depth_m=float(np.ptp(depth)),
            in_contact=float((push > 0).mean()),
            predicted_depth_m=predicted.peak_to_peak * load / item.stiffness if predicted else None,
        )
        for item, load, depth, push in zip(measured, loads, depths, pushes, strict=True)
    )
    swing = max(depths, key=lambda depth: float(np.ptp(depth)))
    halves = [float(np.ptp(half)) for half in np.array_split(swing, 2)]
    size = max(load / item.stiffness for load, item in zip(loads, measured, strict=True))
    quiet = float(np.ptp(swing)) <= QUIET * size
    steady = bounded and (quiet or abs(halves[1] - halves[0]) <= SETTLED * max(halves))
    lines = _lines(time, swing) if steady and not quiet else ()
    if bounded and max(contact.in_contact for contact in contacts) < TOUCHED:
        lines, steady = (), False
        notes: tuple[str, ...] = (LET_GO,)
    else:
        notes = tuple(_notes(predicted, bounded=bounded, steady=steady, lines=lines))
    end = float(simulated.time[-1])
    return LimitCycle(topology, predicted, reason, end, bounded, steady, lines, contacts, notes)


def _notes(
    predicted: Predicted | None, *, bounded: bool, steady: bool, lines: Sequence[SpectralPeak]
) -> list[str]:
    """Return notes on the agreement between prediction and simulation."""
    texts = []
    if not bounded:
        texts.append("the motion played leaves every bound: it comes to no cycle")
    elif not steady:
        texts.append("the motion played still changes at its end: its figures are those of its last part")
    if len(lines) > 1:
        several = " and ".join(f"{line.frequency_hz:.4g} Hz" for line in lines)
        texts.append(
            f"lines stand in the spectrum at {several}, none of which repeats another: one sinusoid says "
            "nothing of such a motion, and what was played counts"
        )
    if predicted and lines and abs(lines[0].frequency_hz / predicted.frequency_hz - 1) > SEPARATE:
        texts.append(
            "what was played is far from what is predicted: the motion is no sinusoid, and what was played "
            "counts"
        )
    if predicted and not predicted.attracts:
        texts.append("the cycle predicted is one that motions leave: what swings less dies out, more grows")
    if predicted and predicted.attracts and steady and not lines:
        texts.append("the motion played came to rest and does not show the cycle predicted")
    if not predicted and lines:
        texts.append("it buzzes all the same, in a way that one sinusoid does not describe")
    return texts


def _lines(time: Floats, values: Floats) -> tuple[SpectralPeak, ...]:
    """Return the lines of a spectrum, multiples of each and mixtures of two left out."""
    step = float(time[-1] - time[0]) / (len(time) - 1)
    window, size = np.hanning(len(time)), FINER * len(time)
    spectrum = 2 / window.sum() * np.abs(np.fft.rfft((values - values.mean()) * window, size))
    separation = 2 / (step * len(time))  # the frequency resolution of this window
    indices, _ = find_peaks(spectrum, height=SECOND * spectrum[1:-1].max())
    lines: list[SpectralPeak] = []
    for index in indices[np.argsort(-spectrum[indices])].tolist():
        near = np.log(spectrum[index - 1 : index + 2])
        aside = 0.5 * (near[0] - near[2]) / (near[0] - 2 * near[1] + near[2])
        frequency = float(index + aside) / (size * step)
        if not _is_mixed(frequency, [line.frequency_hz for line in lines], separation):
            lines.append(SpectralPeak(frequency, float(np.exp(near[1] - 0.25 * (near[0] - near[2]) * aside))))
    return tuple(lines)


def _is_mixed(frequency: float, values: Sequence[float], separation: float) -> bool:
    """Return whether a frequency is known, or a low-order combination of two known ones."""
    times = range(-MIXED, MIXED + 1)
    sums = {i * value + j * other for value in values for other in values for i in times for j in times}
    return any(abs(frequency - value) < separation for value in sums)
