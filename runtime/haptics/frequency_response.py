"""Transparency: the impedance at a device, and the transmission of a force to another device.

Takes: a `Model`, a device, frequencies.
Gives: `Transparency`, `transparency`; `QuasiStaticImpedance`, `HinfGains`, `H2Gains`.
Guarantees: at each frequency the response is exact for the sampled, held and sent signals of the model, with
a bound on its rounding; no aliasing: a frequency beyond half the fastest clock rate raises an error.
Does not: include the dynamics of a hand (see `absolute_stability`), or packets that are lost or late.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import analyze as judge
from apc.analysis.analysis import near_start
from apc.analysis.nonlinear_elements import is_linear
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.frame.evaluation_errors import finite_equations
from apc.frame.interval_arithmetic import UNIT_ROUNDOFF
from apc.frame.numeric_model import Prepared, prepare
from apc.haptics.device_port import DevicePort, check_frequencies, find_port, next_peer, ticks_in
from apc.haptics.network_damping import NetworkDamping, network_damping
from apc.haptics.peer_responses import AROUND, Responses, Weights, gripped_names, responses
from apc.haptics.system_norms import Peak, noise_variance, sampled_data_peak, tick_peak
from apc.network.nominal_criterion import limitations
from apc.result import PlotStyle, Result
from apc.threads import single_threaded
from apc.verdict import Limitation, LimitationCode

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

# The results besides the responses.
ALONGSIDE = ("low_frequency", "network_damping", "hinf", "h2")

# The harmonics of the frame rate that are evaluated in addition to the fundamental.
ALIASES = (0, 1, -1)

# Radii of circles about s = 0, in 1/s: the largest, and the number of halvings.
RADIUS, HALVINGS = 4.0, 14

# The factor above rounding at which means against negative powers indicate a pole within a circle.
DOUBTED = 10.0

# The tolerated difference of quasi-static results of two circles, relative to the largest.
SETTLED = 1e-3


@dataclass(frozen=True, slots=True)
class QuasiStaticImpedance:
    """The quasi-static impedance at a device, down to about 1e-3 1/s: in SI, ± `errors`.

    Z = stiffness/s + damping + mass · s + …; the errors are in the order of the fields.
    """

    mass: float
    damping: float
    stiffness: float
    errors: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class HinfGains:
    """H∞ norms of one mode per newton: of the velocity of devices, and of a copy's distance from the mean.

    `on_ticks` with forces held, and motions read, at the instants of events; `sampled_data` with arbitrary
    forces, whose largest gain is `gains` (k,) at each requested frequency. `of` is the moving quantity: a
    device ("velocity"), or a copy minus the mean of all copies ("error") in a difference mode of equal peers.
    The difference of unequal peers is not computed.
    """

    mode: str
    of: str
    on_ticks: Peak
    sampled_data: Peak
    gains: Floats = field(compare=False)


@dataclass(frozen=True, slots=True)
class H2Gains:
    """Root mean squares at the ticks of a frame, for independent white noise at each peer.

    Motion between ticks is not included.

    `error_m` is that of a copy minus the mean of the others', `velocity_m_s` that of a device: for forces of
    1 N rms at hands, or samples of positions with errors of 1 m rms (a sensor of steps q has an error of
    q/√12). None in a model with a drift driven by it. ± `errors`, in this order, proved.
    """

    source: str
    error_m: float | None
    velocity_m_s: float | None
    errors: tuple[float | None, float | None]


@dataclass(frozen=True, slots=True, eq=False)
class Transparency(Result):
    """The responses at a device, and from it to another device, at frequencies (k,) in Hz.

    `impedance` in N·s/m is force by velocity, with the other devices free; `transmitted_admittance` in m/s/N
    is the other device's velocity by the force here, `coordination_error` in m/N the distance of the object's
    copy here from the mean of the others'. All are complex, those of the fundamental. `aliased_fraction` is
    the largest ratio of an alias at the device, at frequencies a frame rate apart, to the fundamental.
    `network_damping` is the part of the damping caused by the network. `bound` is the relative error bound of
    the impedance; `transmitted_bound` and `error_bound` those of the others.
    """

    shown_by = "haptics_output:transparency"

    topology: str
    at: str
    between: str
    object: str
    frequency_hz: Floats
    impedance: Complex
    transmitted_admittance: Complex
    coordination_error: Complex
    aliased_fraction: Floats
    bound: Floats
    transmitted_bound: Floats
    error_bound: Floats
    low_frequency: QuasiStaticImpedance | None
    network_damping: NetworkDamping | None
    hinf: tuple[HinfGains, ...]
    h2: tuple[H2Gains, ...]
    stable: bool | None
    linearized: bool
    limitations: tuple[str, ...]
    notes: tuple[Limitation, ...]

    def plot(self, ax: Any = None, *, kind: str = "bode", **style: Unpack[PlotStyle]) -> Any:
        """Draw Bode's plot or Nyquist's, as `style` says (see `result.PlotStyle`); return the matplotlib
        Figure.

        Parameters
        ----------
        ax
            The matplotlib Axes to draw into; a Bode plot then has the magnitudes alone.
        kind
            "bode" or "nyquist".
        """
        return self._plotted(kind, ax, style=style)


@part("transparency")
def transparency(
    system: Model,
    frequencies: Sequence[float] | Floats,
    *,
    at: str = "",
    between: str = "",
    unstable: bool = False,
    alongside: Collection[str] = ALONGSIDE,
    prepared: Prepared | None = None,
) -> Transparency:
    """Return the transparency of a model at a device.

    Parameters
    ----------
    system
        The compiled model, with the parameter values to analyse.
    frequencies
        (k,), in Hz, above 0 and at most half the rate of the fastest clock.
    at, between
        The driven device, and another whose motion is requested: `left[1].device`. The defaults are the
        device of the first peer that has one, along the first of its directions, and the next peer's.
    unstable
        Whether the map of an unstable model is allowed, which has no response in time.
    alongside
        The optional results, of `ALONGSIDE`; some tens of milliseconds each.
    prepared
        From `numeric_model.prepare`, of this system with any numbers.

    Raises
    ------
    ApcError
        E931 a peer without a device; E934 an unstable model; E935 a frequency beyond half the fastest clock
        rate, or none above 0; E936 an unknown name; E933 a model too large.
    """
    result = np.asarray(frequencies, dtype=np.float64).ravel()
    prepared = prepared or prepare(system)
    named = [] if at else gripped_names(system, prepared)
    port = find_port(system, at or next(iter(named), ""), "--at")
    other = find_port(system, between, "--between") if between else DevicePort(next_peer(system, port), "")
    check_frequencies(system, result)
    verdict = judge(system, prepared=prepared)
    if verdict.stable is False and not unstable:
        raise _unstable(system, verdict.spectral_radius)
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        answers = responses(system, prepared, port, other)
        s = np.asarray(2j * np.pi * result, dtype=np.complex128)
        pair, *aliases, across, error = answers.steady(s, ALIASES)
        values = 1 / pair[0]
        alias = np.max([np.abs(value) for value, _ in aliases], axis=0) / np.abs(pair[0])
        bounds = [
            1.01 * error_bound / np.where(value == 0, np.inf, np.abs(value))
            for value, error_bound in (pair, across, error)
        ]
        steady = verdict.stable is not False
        slow = _slow(answers) if "low_frequency" in alongside else None
        viscosity = _viscosity(system, slow, port, other) if slow and "network_damping" in alongside else None
        hinf = _extremes(answers, result) if "hinf" in alongside else ()
        h2 = _noise(system, answers) if steady and "h2" in alongside else ()
    linear = is_linear(system, prepared)
    here, there = (
        f"{answers.exchange.peer_name(item.peer)}.{device.part}"
        for item, device in ((port, answers.device), (other, answers.other))
    )
    directions = [text for text in named if text.partition(".")[0] == named[0].partition(".")[0]]
    others = ", ".join(f"--at {direction}" for direction in directions[1:])
    applicable = {
        Limitation(LimitationCode.ONE_DIRECTION, (others,)): len(directions) > 1,
        Limitation(LimitationCode.UNSTABLE_MAP): verdict.stable is False,
        Limitation(LimitationCode.SLOWER_MOTION): not slow and "low_frequency" in alongside,
        Limitation(LimitationCode.COUPLED_COPIES): "hinf" in alongside and bool(answers.error[0]),
        Limitation(LimitationCode.CLOCK_PHASE): steady and not h2 and "h2" in alongside,
    }
    return Transparency(
        topology=system.name,
        at=here,
        between="" if there == here else there,
        object=answers.object,
        frequency_hz=result,
        impedance=values,
        transmitted_admittance=across[0],
        coordination_error=error[0],
        aliased_fraction=alias,
        bound=bounds[0],
        transmitted_bound=bounds[1],
        error_bound=bounds[2],
        low_frequency=slow,
        network_damping=viscosity,
        hinf=hinf,
        h2=h2,
        stable=verdict.stable,
        linearized=not linear,
        limitations=(*near_start(system, prepared), *limitations(system)),
        notes=tuple(limitation for limitation, applies in applicable.items() if applies),
    )


def _viscosity(
    system: Model, slow: QuasiStaticImpedance, port: DevicePort, other: DevicePort
) -> NetworkDamping | None:
    """Return the part of the quasi-static damping that the network causes."""

    def damping_of(changed: Model) -> tuple[float, float] | None:
        slow = _slow(responses(changed, prepare(changed), port, other))
        return None if slow is None else (slow.damping, slow.errors[1])

    return network_damping(system, (slow.damping, slow.errors[1]), damping_of)


def _unstable(system: Model, radius: float) -> ApcError:
    message = (
        f"the topology is unstable (spectral radius {radius:.6g}): what a push makes of it grows, and "
        "it has no "
        "response in time"
    )
    hint = "--unstable, for that of the map from force to motion"
    return ApcError(Diagnostic("E934", SourceLocation(system.origin.topology), message, hint=hint))


def _slow(response: Responses) -> QuasiStaticImpedance | None:
    """Return mass, damping and stiffness at low frequency, None where undetermined.

    Notes
    -----
    s Z(s) has no pole within a small circle about 0, so its Taylor coefficients are the means of its values
    on the circle against powers of s (Cauchy); those of two circles differ by the truncation error. With a
    pole within, means against negative powers do not vanish.
    """
    before, radius = None, RADIUS
    best: QuasiStaticImpedance | None = None
    least = SETTLED
    for _ in range(HALVINGS):
        s = radius * np.exp(2j * np.pi * (np.arange(AROUND) + 0.5) / AROUND)
        (velocity, error_bound), *_ = response.at(s, difference_loops=False)
        values, powers = s / velocity, radius ** np.arange(3)
        uncertainty = float((np.abs(values) * error_bound / np.abs(velocity)).max())
        result = np.array([(values / s**power).mean().real for power in range(3)])
        if before is not None:
            inside = max(abs((values * (s / radius) ** power).mean()) for power in (1, 2, 3))
            error_bound = np.abs(result - before) + (uncertainty + inside) / powers
            # At this speed, a term is negligible if far smaller than the largest.
            share = float((error_bound * powers).max() / np.abs(result * powers).max())
            if share < least and inside <= DOUBTED * uncertainty:
                least, (k, b, m), (off_k, error_bound_b, off_m) = share, result.tolist(), error_bound.tolist()
                best = QuasiStaticImpedance(m, b, k, (off_m, error_bound_b, off_k))
        before, radius = result, radius / 2
    return best


def _extremes(response: Responses, frequency_hz: Floats) -> tuple[HinfGains, ...]:
    """Return the H∞ norms, and gains at frequencies (k,), of the driven peer's modes."""
    result, copy = [], response.copies[response.local]
    for number, subsystem, _ in response.parts:
        loop, basis = response.loops[number], response.bases[number]
        rows = [("velocity", response.device.velocity)]
        if number and copy is not None:
            rows.append(("error", copy[1]))
        for name, row in rows:
            local = (loop, subsystem, subsystem, row, basis)
            result.append(
                HinfGains(loop.name, name, tick_peak(*local), *sampled_data_peak(*local, frequency_hz))
            )
    return tuple(result)


def _noise(system: Model, response: Responses) -> tuple[H2Gains, ...]:
    """Return the rms response of the driven peer to white noise at all peers."""
    ticks = ticks_in(system, response.frame)
    if ticks is None:
        return ()
    noises = []
    for source, sensors in (("hands", False), ("sensors", True)):
        velocity = _variance(response, ticks, response.velocity, sensors=sensors)
        error = _variance(response, ticks, response.error, sensors=sensors)
        (error_m, error_off), (velocity_m_s, velocity_off) = map(_rms, (error, velocity))
        noises.append(H2Gains(source, error_m, velocity_m_s, (error_off, velocity_off)))
    return tuple(noises)


def _rms(variance: tuple[float, float] | None) -> tuple[float, float] | tuple[None, None]:
    """Return the root of a variance, and its error bound."""
    if variance is None:
        return None, None
    value, error_bound = variance
    root = max(value, 0.0) ** 0.5
    return root, min(error_bound / root if root else np.inf, error_bound**0.5) + 2 * UNIT_ROUNDOFF * root


def _variance(
    response: Responses, ticks: list[Fraction], weights: Weights, *, sensors: bool
) -> tuple[float, float] | None:
    """Return the variance of states of the driven peer, with independent noise at each peer of a class.

    With an error bound.
    """
    if not any(weights):
        return None
    total = error_bound = 0.0
    gripped = [
        index for index, subsystem in enumerate(response.loops[0].subsystems) if subsystem.device is not None
    ]
    for (number, subsystem, share), outputs in zip(response.parts, weights, strict=False):
        sources = {subsystem: share} if number else {index: 1 / response.members[index] for index in gripped}
        if outputs:
            loop, basis = response.loops[number], response.bases[number]
            pair = noise_variance(loop, ticks, sources, outputs, basis, sensors=sensors)
            if pair is None:
                return None
            total, error_bound = total + pair[0], error_bound + pair[1]
    return total, error_bound + 2 * UNIT_ROUNDOFF * total
