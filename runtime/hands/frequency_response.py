"""What a hand feels: how its device answers a force, and how a push arrives at another hand.

Takes: a `Model`, a device, frequencies.
Gives: `Transparency`, `feel`; `QuasiStaticImpedance`, `HinfGains`, `H2Gains`.
Guarantees: at each frequency the answer is exact for the sampled, held and sent signals of the scene, with a
bound on its rounding; nothing is folded: a frequency beyond half the fastest clock is refused.
Does not: look at how a hand answers back (see `passivity`), or at packets that are lost or late.
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
from apc.analysis.elements import is_linear
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.frame.finite_equations import finite_equations
from apc.frame.instance import Prepared, prepare
from apc.frame.radius import UNIT
from apc.hands.answers import AROUND, Responses, Weights, held_names, responses
from apc.hands.asked import DevicePort, check_frequencies, find_port, next_peer, ticks_in
from apc.hands.system_norms import Peak, noise_variance, sampled_data_peak, tick_peak
from apc.hands.viscosity import NetworkDamping, network_viscosity
from apc.network.nominal import left_out
from apc.result import PlotStyle, Result
from apc.threads import single_threaded
from apc.verdict import Limitation, LimitationCode

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

# What is told beside the responses.
BESIDE = ("low_frequency", "network_viscosity", "hinf", "h2")

# The harmonics of the frame rate that are looked at beside the fundamental.
ALIASES = (0, 1, -1)

# Radii of circles about s = 0, in 1/s: the largest, and how many times it is halved.
RADIUS, HALVINGS = 4.0, 14

# By how much more than rounding means against negative powers may tell of a pole within a circle.
DOUBTED = 10.0

# What of slow motions two circles may tell differently, beside the largest.
SETTLED = 1e-3


@dataclass(frozen=True, slots=True)
class QuasiStaticImpedance:
    """What is felt of slow motions, down to some 1e-3 a second: mass, damping, stiffness in SI, ± `errors`.

    Z = stiffness/s + damping + mass · s + …; the errors are in the order of the fields.
    """

    mass: float
    damping: float
    stiffness: float
    errors: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class HinfGains:
    """H∞ norms of one mode: of the velocity of devices, and of how far a copy is from the mean, a newton.

    `on_ticks` with forces held, and motions read, at the instants at which something happens; `sampled_data`
    with forces of any course, whose largest gain is `gains` (k,) at each frequency that was asked for.
    `of` is what moves: a device ("velocity"), or a copy less the mean of all copies ("error") where peers
    that are alike move apart. How far peers that differ move apart together is not told.
    """

    mode: str
    of: str
    on_ticks: Peak
    sampled_data: Peak
    gains: Floats = field(compare=False)


@dataclass(frozen=True, slots=True)
class H2Gains:
    """Root mean squares at the ticks of a frame, for noise of each peer's own, white from tick to tick.

    Motion between ticks is not included.

    `error_m` of a copy less the mean of the others', `velocity_m_s` of a device: for forces of 1 N rms at
    hands, or samples of positions off by 1 m rms (a sensor of steps q is off by q/√12). None in a scene that
    drifts for it. ± `errors`, in this order, proved.
    """

    source: str
    error_m: float | None
    velocity_m_s: float | None
    errors: tuple[float | None, float | None]


@dataclass(frozen=True, slots=True, eq=False)
class Transparency(Result):
    """What is felt at a device, and what of a push there arrives at another, at frequencies (k,) in Hz.

    `impedance` in N·s/m is force by velocity, where hands push and others are free; `transmitted_admittance`
    in m/s/N is the other device's velocity by the force here, `error_per_force` in m/N how far the copy of
    the object here is from the mean of the others'. All are complex, the fundamental's. `alias` is the
    largest of what else comes at the device, at frequencies a frame rate apart, beside the fundamental.
    `network_viscosity` is what of the damping felt comes of the network.
    `bound` is what the impedance may be off by, relatively; `transmitted_bound` and `error_bound` the others.
    """

    shown_by = "hands_output:feel"

    topology: str
    at: str
    between: str
    copy: str
    frequency_hz: Floats
    impedance: Complex
    transmitted_admittance: Complex
    error_per_force: Complex
    alias: Floats
    bound: Floats
    transmitted_bound: Floats
    error_bound: Floats
    low_frequency: QuasiStaticImpedance | None
    network_viscosity: NetworkDamping | None
    hinf: tuple[HinfGains, ...]
    h2: tuple[H2Gains, ...]
    stable: bool | None
    linearized: bool
    left_out: tuple[str, ...]
    notes: tuple[Limitation, ...]

    def plot(self, ax: Any = None, *, kind: str = "bode", **look: Unpack[PlotStyle]) -> Any:
        """Draw Bode's plot or Nyquist's, as `look` says (see `result.PlotStyle`); return the matplotlib
        Figure.

        Parameters
        ----------
        ax
            The matplotlib Axes to draw into, of Bode's plot the magnitudes alone.
        kind
            "bode" or "nyquist".
        """
        return self._drawn(kind, ax, look=look)


@part("feel")
def feel(
    system: Model,
    frequencies: Sequence[float] | Floats,
    *,
    at: str = "",
    between: str = "",
    unstable: bool = False,
    beside: Collection[str] = BESIDE,
    prepared: Prepared | None = None,
) -> Transparency:
    """Say what a hand feels.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    frequencies
        (k,), in Hz, above 0 and at most half the rate of the fastest clock.
    at, between
        The device that is pushed, and another whose motion is asked for: `left[1].device`. That of the first
        peer who has one, along the first of its directions, and the next peer's, if not given.
    unstable
        Whether the map of an unstable scene is wanted, which has no response in time.
    beside
        What is told beside the responses, of `BESIDE`; some tens of milliseconds each.
    prepared
        From `instance.prepare`, of this system with any numbers.

    Raises
    ------
    ApcError
        E931 a peer without a device; E934 an unstable scene; E935 a frequency beyond half the fastest clock,
        or none above 0; E936 a name that means nothing; E933 a scene too large.
    """
    result = np.asarray(frequencies, dtype=np.float64).ravel()
    prepared = prepared or prepare(system)
    named = [] if at else held_names(system, prepared)
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
            1.01 * off / np.where(value == 0, np.inf, np.abs(value)) for value, off in (pair, across, error)
        ]
        steady = verdict.stable is not False
        slow = _slow(answers) if "low_frequency" in beside else None
        viscosity = _viscosity(system, slow, port, other) if slow and "network_viscosity" in beside else None
        hinf = _extremes(answers, result) if "hinf" in beside else ()
        h2 = _noise(system, answers) if steady and "h2" in beside else ()
    linear = is_linear(system, prepared)
    here, there = (
        f"{answers.exchange.peer_name(item.peer)}.{device.part}"
        for item, device in ((port, answers.device), (other, answers.other))
    )
    directions = [text for text in named if text.partition(".")[0] == named[0].partition(".")[0]]
    others = ", ".join(f"--at {direction}" for direction in directions[1:])
    limitations = {
        Limitation(LimitationCode.ONE_DIRECTION, (others,)): len(directions) > 1,
        Limitation(LimitationCode.UNSTABLE_MAP): verdict.stable is False,
        Limitation(LimitationCode.SLOWER_MOTION): not slow and "low_frequency" in beside,
        Limitation(LimitationCode.COUPLED_COPIES): "hinf" in beside and bool(answers.error[0]),
        Limitation(LimitationCode.CLOCK_PHASE): steady and not h2 and "h2" in beside,
    }
    return Transparency(
        topology=system.name,
        at=here,
        between="" if there == here else there,
        copy=answers.copy,
        frequency_hz=result,
        impedance=values,
        transmitted_admittance=across[0],
        error_per_force=error[0],
        alias=alias,
        bound=bounds[0],
        transmitted_bound=bounds[1],
        error_bound=bounds[2],
        low_frequency=slow,
        network_viscosity=viscosity,
        hinf=hinf,
        h2=h2,
        stable=verdict.stable,
        linearized=not linear,
        left_out=(*near_start(system, prepared), *left_out(system)),
        notes=tuple(limitation for limitation, applies in limitations.items() if applies),
    )


def _viscosity(
    system: Model, slow: QuasiStaticImpedance, port: DevicePort, other: DevicePort
) -> NetworkDamping | None:
    """Return what of the damping felt of slow motions comes of the network."""

    def damping_of(changed: Model) -> tuple[float, float] | None:
        slow = _slow(responses(changed, prepare(changed), port, other))
        return None if slow is None else (slow.damping, slow.errors[1])

    return network_viscosity(system, (slow.damping, slow.errors[1]), damping_of)


def _unstable(system: Model, radius: float) -> ApcError:
    what = (
        f"the scene is unstable (spectral radius {radius:.6g}): what a push makes of it grows, and it has no "
        "response in time"
    )
    hint = "--unstable, for that of the map from force to motion"
    return ApcError(Diagnostic("E934", SourceLocation(system.origin.topology), what, hint=hint))


def _slow(felt: Responses) -> QuasiStaticImpedance | None:
    """Return mass, damping and stiffness at low frequency, None where they can't be told.

    Notes
    -----
    s Z(s) has no pole within a small circle about 0, so its Taylor coefficients are the means of its
    values on the circle against powers of s (Cauchy); those of two circles differ by what is left out.
    With a pole within, means against negative powers don't vanish.
    """
    before, radius = None, RADIUS
    best: QuasiStaticImpedance | None = None
    least = SETTLED
    for _ in range(HALVINGS):
        s = radius * np.exp(2j * np.pi * (np.arange(AROUND) + 0.5) / AROUND)
        (velocity, off), *_ = felt.at(s, apart=False)
        values, powers = s / velocity, radius ** np.arange(3)
        doubt = float((np.abs(values) * off / np.abs(velocity)).max())
        result = np.array([(values / s**power).mean().real for power in range(3)])
        if before is not None:
            inside = max(abs((values * (s / radius) ** power).mean()) for power in (1, 2, 3))
            off = np.abs(result - before) + (doubt + inside) / powers
            # At this speed, none matters that is far smaller than the largest.
            share = float((off * powers).max() / np.abs(result * powers).max())
            if share < least and inside <= DOUBTED * doubt:
                least, (k, b, m), (off_k, off_b, off_m) = share, result.tolist(), off.tolist()
                best = QuasiStaticImpedance(m, b, k, (off_m, off_b, off_k))
        before, radius = result, radius / 2
    return best


def _extremes(felt: Responses, frequency_hz: Floats) -> tuple[HinfGains, ...]:
    """Return the H∞ norms, and gains at frequencies (k,), of the modes that the pushed peer is in."""
    result, copy = [], felt.copies[felt.own]
    for number, site, _ in felt.parts:
        loop, basis = felt.loops[number], felt.bases[number]
        rows = [("velocity", felt.device.velocity)]
        if number and copy is not None:
            rows.append(("error", copy[1]))
        for name, row in rows:
            own = (loop, site, site, row, basis)
            result.append(HinfGains(loop.name, name, tick_peak(*own), *sampled_data_peak(*own, frequency_hz)))
    return tuple(result)


def _noise(system: Model, felt: Responses) -> tuple[H2Gains, ...]:
    """Return what white noise at all peers does to the pushed peer."""
    ticks = ticks_in(system, felt.frame)
    if ticks is None:
        return ()
    noises = []
    for source, sensors in (("hands", False), ("sensors", True)):
        velocity = _variance(felt, ticks, felt.velocity, sensors=sensors)
        error = _variance(felt, ticks, felt.error, sensors=sensors)
        (error_m, error_off), (velocity_m_s, velocity_off) = map(_rms, (error, velocity))
        noises.append(H2Gains(source, error_m, velocity_m_s, (error_off, velocity_off)))
    return tuple(noises)


def _rms(variance: tuple[float, float] | None) -> tuple[float, float] | tuple[None, None]:
    """Return the root of a variance, and a bound on what that is off by."""
    if variance is None:
        return None, None
    value, off = variance
    root = max(value, 0.0) ** 0.5
    return root, min(off / root if root else np.inf, off**0.5) + 2 * UNIT * root


def _variance(
    felt: Responses, ticks: list[Fraction], weights: Weights, *, sensors: bool
) -> tuple[float, float] | None:
    """Return the variance of states of the pushed peer, each class's noise its own at each of its peers.

    With a bound on what it is off by.
    """
    if not any(weights):
        return None
    total = off = 0.0
    held = [place for place, site in enumerate(felt.loops[0].sites) if site.device is not None]
    for (number, site, share), outputs in zip(felt.parts, weights, strict=False):
        sources = {site: share} if number else {place: 1 / felt.members[place] for place in held}
        if outputs:
            loop, basis = felt.loops[number], felt.bases[number]
            pair = noise_variance(loop, ticks, sources, outputs, basis, sensors=sensors)
            if pair is None:
                return None
            total, off = total + pair[0], off + pair[1]
    return total, off + 2 * UNIT * total
