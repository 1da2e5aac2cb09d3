"""Limit cycles of one-sided contacts: describing-function prediction and simulation.

Takes: a `NumericModel` whose peers have one-sided contacts.
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

from apc.compiler.compiled import LENGTH, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.extensions.switching.describing_function import Predicted, predict
from apc.extensions.switching.lure_form import contact_classes
from apc.extensions.switching.sector_nonlinearity import SectorNonlinearity
from apc.lifting.numeric_model import NumericModel
from apc.parameter_values.parameters import resolve
from apc.result import Result
from apc.simulation.trajectory import Trajectory, simulate
from apc.spectrum.peer_classes import PeerClass
from apc.support.not_supported import NotSupportedError
from apc.timing.communication_graph import build_comm_graph

Floats = NDArray[np.float64]

# The duration of the simulation, in seconds: the least for many peers, the most for few; and its last part,
# which is measured.
SHORTEST, LONGEST, MEASURED = 8, 80, 4

# The fraction of time below which a contact counts as open; the relative difference of distinct frequencies.
TOUCHED, SEPARATE = 1e-3, 0.2

LET_GO = "all contacts have separated, so there is no limit cycle"

# Peers whose contacts are measured; ticks of all peers that are simulated, some ten seconds' worth.
MOST_PEERS, MOST_SIMULATED = 20, 2 * 10**7

# The peak-to-peak depth, relative to the mean depth, below which there is no oscillation; the relative change
# over the measured part below which an oscillation is stationary.
QUIET, SETTLED = 1e-4, 0.02

# The smallest relative amplitude of a second spectral line; leakage of a steady oscillation is far smaller.
# Of two lines, combination frequencies up to this order, and their multiples, are not counted as a third.
SECOND, COMBINATION_ORDER = 0.1, 3

BY_CHANCE = "predicted for the nominal network, simulated with packet loss and jitter"

# Spectrum points between two resolvable frequencies.
FINER = 8


@dataclass(frozen=True, slots=True)
class SpectralPeak:
    """A peak in the spectrum of the contact depth with the largest range: frequency, and amplitude in m."""

    frequency_hz: float
    amplitude_m: float


@dataclass(frozen=True, slots=True)
class ContactLimitCycle:
    """A simulated contact, and its predicted depth under the same load.

    `load_n` is its mean force; `depth_m` the peak-to-peak depth, `in_contact` the share of the time in
    contact. `predicted_depth_m` is None without a prediction.
    """

    name: str
    load_n: float
    depth_m: float
    in_contact: float
    predicted_depth_m: float | None


@dataclass(frozen=True, slots=True)
class LimitCycle(Result):
    """A limit cycle of contacts, predicted and simulated over `simulated_s` seconds.

    `predicted` is None if `reason` is given. `lines` are the peaks of the spectrum, the largest first; empty
    if the motion comes to rest or is not stationary. `steady` states that the oscillation is stationary,
    `bounded` that the simulation reached its end. `notes` describe the validity of the prediction.
    """

    shown_by = "apc.extensions.switching.switching_output:limit_cycle"

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
class _RecordedContact:
    """A contact of one peer: name of its force, names and factors of the states that form its depth."""

    name: str
    states: tuple[str, ...]
    factors: Floats
    offset: float
    stiffness: float


@part("limit cycle")
def limit_cycle(
    numeric: NumericModel,
) -> LimitCycle:
    """Return the predicted and the simulated limit cycle of a model's one-sided contacts.

    Parameters
    ----------
    numeric
        The model with its parameter values.

    Raises
    ------
    ApcError
        E864 no one-sided contact at ticks; and the errors of `trajectory.simulate`.
    """
    model = numeric.model
    try:
        with_contacts = contact_classes(numeric)
    except NotSupportedError as why:
        raise _no_limit_cycle(model, str(why)) from None
    if not any(forces for _, forces in with_contacts):
        raise _no_limit_cycle(model, "no contact is closed")
    for _, forces in with_contacts:
        for push in forces:
            if not push.unilateral:
                raise _no_limit_cycle(model, f"{push.part} also pulls, or is limited")
    contacts = _contacts(model, with_contacts)
    predicted, reason = None, ""
    try:
        predicted = predict(model, with_contacts)
    except NotSupportedError as why:
        reason = str(why)
    seconds = _duration(model)
    names = [contact.name for contact in contacts] + [
        state for contact in contacts for state in contact.states
    ]
    simulated = simulate(model, duration=seconds, signals=tuple(dict.fromkeys(names)))
    result = _comparison(model.name, predicted, reason, simulated, contacts)
    if all(link.channel is None for link in model.links):
        return result
    return replace(result, notes=(*result.notes, BY_CHANCE))


def _duration(model: Model) -> Fraction:
    """Return the simulated duration in whole seconds: `LONGEST`, or less for many peers."""
    timings = {timing.name: timing.value for timing in model.timings}
    tick = min(timings[clock.period] for clock in model.clocks)
    most = math.floor(MOST_SIMULATED * tick / model.peers)
    if most < SHORTEST:
        raise _no_limit_cycle(model, f"{model.peers:,} peers are too many to simulate for {SHORTEST} s")
    return Fraction(min(most, LONGEST))


def _no_limit_cycle(model: Model, why: str) -> ApcError:
    """Return the error E864 with the reason why no limit cycle is predicted."""
    message = f"no limit cycle is predicted: {why}"
    return ApcError(Diagnostic("E864", SourceLocation(model.origin.topology), message, fix="apc simulate"))


def _contacts(
    model: Model, with_contacts: Sequence[tuple[PeerClass, tuple[SectorNonlinearity, ...]]]
) -> list[_RecordedContact]:
    """Return the contacts to record: those of the first peers of each class."""
    comm_graph = build_comm_graph(model, resolve(model).timings)
    peers_per_class = max(1, MOST_PEERS // len(with_contacts))
    result = []
    for peer_class, forces in with_contacts:
        for peer in itertools.islice(peer_class.peers, peers_per_class):
            name = comm_graph.peer_name(peer)
            for push in forces:
                states = peer_class.jacobians.peer_type.states
                indices = [k for k, state in enumerate(states) if state.unit == LENGTH and push.slopes[k]]
                if push.slopes[push.states :].any() or not indices:
                    raise _no_limit_cycle(model, f"{push.part} depends on more than positions and velocities")
                stiffness = float(np.abs(push.slopes[indices]).max())
                result.append(
                    _RecordedContact(
                        f"{name}.{push.part}",
                        tuple(f"{name}.{states[k].name}" for k in indices),
                        push.slopes[indices] / stiffness,
                        push.offset / stiffness,
                        stiffness,
                    )
                )
    return result


def _comparison(
    topology: str,
    predicted: Predicted | None,
    reason: str,
    simulated: Trajectory,
    recorded: Sequence[_RecordedContact],
) -> LimitCycle:
    """Return the limit cycle from the prediction, or the reason for its absence, and the simulation."""
    first = len(simulated.time) - len(simulated.time) // MEASURED
    bounded = not simulated.summary.stopped
    time = simulated.time[first:]
    depths = [
        contact_record.offset
        + sum(
            factor * simulated[state][first:]
            for factor, state in zip(contact_record.factors, contact_record.states, strict=True)
        )
        for contact_record in recorded
    ]
    forces = [simulated[contact_record.name][first:] for contact_record in recorded]
    window = np.hanning(len(time))
    loads = [float(contact_force @ window / window.sum()) for contact_force in forces]
    contacts = tuple(
        ContactLimitCycle(
            name=contact_record.name,
            load_n=load,
            depth_m=float(np.ptp(depth)),
            in_contact=float((contact_force > 0).mean()),
            predicted_depth_m=predicted.peak_to_peak * load / contact_record.stiffness if predicted else None,
        )
        for contact_record, load, depth, contact_force in zip(recorded, loads, depths, forces, strict=True)
    )
    largest_depth = max(depths, key=lambda depth: float(np.ptp(depth)))
    halves = [float(np.ptp(half)) for half in np.array_split(largest_depth, 2)]
    mean_depth = max(
        load / contact_record.stiffness for load, contact_record in zip(loads, recorded, strict=True)
    )
    quiet = float(np.ptp(largest_depth)) <= QUIET * mean_depth
    steady = bounded and (quiet or abs(halves[1] - halves[0]) <= SETTLED * max(halves))
    lines = _spectral_peaks(time, largest_depth) if steady and not quiet else ()
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
        texts.append("the simulated motion diverges; there is no limit cycle")
    elif not steady:
        texts.append("the simulated motion is not yet periodic; the values are those of its last part")
    if len(lines) > 1:
        several = " and ".join(f"{line.frequency_hz:.4g} Hz" for line in lines)
        texts.append(
            f"the spectrum has lines at {several} that are not harmonics of each other; a describing "
            "function "
            "does not apply, and the simulation is decisive"
        )
    if predicted and lines and abs(lines[0].frequency_hz / predicted.frequency_hz - 1) > SEPARATE:
        texts.append(
            "the simulation differs from the prediction, as the motion is not sinusoidal; the simulation "
            "is decisive"
        )
    if predicted and not predicted.attracts:
        texts.append("the predicted cycle is unstable: smaller oscillations decay, larger ones grow")
    if predicted and predicted.attracts and steady and not lines:
        texts.append("the simulated motion came to rest; the predicted cycle was not reached")
    if not predicted and lines:
        texts.append("the simulation shows a limit cycle that one sinusoid does not describe")
    return texts


def _spectral_peaks(time: Floats, values: Floats) -> tuple[SpectralPeak, ...]:
    """Return the peaks of a spectrum, without multiples of a peak and combinations of two peaks."""
    step = float(time[-1] - time[0]) / (len(time) - 1)
    window, size = np.hanning(len(time)), FINER * len(time)
    spectrum = 2 / window.sum() * np.abs(np.fft.rfft((values - values.mean()) * window, size))
    resolution = 2 / (step * len(time))  # the frequency resolution of this window
    indices, _ = find_peaks(spectrum, height=SECOND * spectrum[1:-1].max())
    lines: list[SpectralPeak] = []
    for index in indices[np.argsort(-spectrum[indices])].tolist():
        log_neighbours = np.log(spectrum[index - 1 : index + 2])
        offset = (
            0.5
            * (log_neighbours[0] - log_neighbours[2])
            / (log_neighbours[0] - 2 * log_neighbours[1] + log_neighbours[2])
        )
        frequency = float(index + offset) / (size * step)
        if not _is_combination(frequency, [line.frequency_hz for line in lines], resolution):
            lines.append(
                SpectralPeak(
                    frequency,
                    float(
                        np.exp(log_neighbours[1] - 0.25 * (log_neighbours[0] - log_neighbours[2]) * offset)
                    ),
                )
            )
    return tuple(lines)


def _is_combination(frequency: float, known: Sequence[float], resolution: float) -> bool:
    """Return whether a frequency is known, or a low-order combination of two known frequencies."""
    factors = range(-COMBINATION_ORDER, COMBINATION_ORDER + 1)
    combinations = {
        i * first + j * second for first in known for second in known for i in factors for j in factors
    }
    return any(abs(frequency - first) < resolution for first in combinations)
