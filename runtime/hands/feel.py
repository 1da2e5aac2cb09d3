"""What a hand feels: how its device answers a force, and how a push arrives at another hand.

Takes: a `CompiledSystem`, a device, frequencies.
Gives: `Feel`, `feel`; `Slow`, `Extremes`, `Noise`; `Port`, `find_port`; `read_frequencies`, `fastest`.
Guarantees: at each frequency the answer is exact for the sampled, held and sent signals of the scene, with a
bound on its rounding; nothing is folded: a frequency beyond half the fastest clock is refused.
Does not: look at how a hand answers back (see `passivity`), or at packets that are lost or late.

Peers' answers are put together from those of modes: with all n peers of a class alike, or one against their
mean, a push at one of them is 1/n of the first and 1 − 1/n of the second.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, lifted_groups, prepare
from apc.analysis.analysis import analyze as judge
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place, nearest
from apc.compiler.language.vectors import whole_and_index
from apc.compiler.timings import part
from apc.eigen.closing import Loop
from apc.eigen.modes import arrange, dense_loop
from apc.eigen.peer_group import MOST_STATES, PeerGroup
from apc.eigen.rigid import find_rigid_modes
from apc.finite_equations import finite_equations
from apc.frame.devices import OWN_MASS, Device, find_device
from apc.frame.discretize import UNIT
from apc.frame.exchange import Exchange
from apc.frame.parameters import resolve
from apc.hands.norms import Peak, noise_variance, sampled_data_peak, tick_peak
from apc.hands.response import Carried, Pushed, add, open_site, pushed_loop, spectra
from apc.network.nominal import left_out
from apc.option_value import option_value
from apc.result import Result
from apc.threads import single_threaded

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

# The harmonics of the frame rate that are looked at beside the fundamental.
ALIASES = (0, 1, -1)

# Points of a circle about s = 0, and its radii in 1/s, one after the other half as large.
AROUND, RADIUS, HALVINGS = 16, 4.0, 14

# Turns a frame, so near a whole number of which a scene that may rest anywhere is asked around a frequency,
# and how far around, in 1/s.
NEAR, ASIDE = 1e-5, 0.25

# By how much more than rounding means against negative powers may tell of a pole within a circle.
DOUBTED = 10.0

# What of slow motions two circles may tell differently, beside the largest.
SETTLED = 1e-3

# The highest frequency in Hz, where none is named: hands feel more, and do less.
HIGHEST = 60.0

# States and readings of all kinds of peers together, in one matrix.
MOST_TOGETHER = 2000

# Intervals of a peer times its states, of what is kicked and read in a frame.
MOST_KICKS = 4000


@dataclass(frozen=True, slots=True)
class Slow:
    """What is felt of slow motions, down to some 1e-3 a second: mass, damping, stiffness in SI, ± `errors`.

    Z = stiffness/s + damping + mass · s + …; the errors are in the order of the fields.
    """

    mass: float
    damping: float
    stiffness: float
    errors: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Extremes:
    """H∞ norms of one mode: of the velocity of devices, and of how far a copy is from the others, a newton.

    `on_ticks` with forces held, and motions read, at the instants at which something happens; `sampled_data`
    with forces of any course. `of` is what moves; a copy's is None in a mode in which all move alike.
    """

    mode: str
    of: str
    on_ticks: Peak
    sampled_data: Peak


@dataclass(frozen=True, slots=True)
class Noise:
    """Root mean squares over the ticks of a frame, for noise of each peer's own, white from tick to tick.

    `error_m` of a copy less the mean of the others', `velocity_m_s` of a device: for forces of 1 N rms at
    hands, or samples of positions off by 1 m rms (a sensor of steps q is off by q/√12). None in a scene that
    drifts for it. By a Lyapunov equation in floats, without a bound.
    """

    source: str
    error_m: float | None
    velocity_m_s: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Feel(Result):
    """What is felt at a device, and what of a push there arrives at another, at frequencies (k,) in Hz.

    `impedance` in N·s/m is force by velocity, where hands push and others are free; `transmitted_admittance`
    in m/s/N is the other device's velocity by the force here, `error_per_force` in m/N how far the copy of
    the object here is from the mean of the others'. All are complex, the fundamental's. `alias` is the
    largest of what else comes at the device, at frequencies a frame rate apart, beside the fundamental.
    `bound` is what the impedance may be off by, relatively; `transmitted_bound` and `error_bound` the others.
    """

    shown_by = "hands:feel"

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
    low_frequency: Slow | None
    hinf: tuple[Extremes, ...]
    h2: tuple[Noise, ...]
    stable: bool | None
    linearized: bool
    left_out: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Port:
    """A device: its peer, counted from 0 over all groups, and the part, "" for the only one there is."""

    peer: int
    part: str


_PORT = re.compile(r"(?:(?P<group>[^.\[\]]+)\[(?P<number>[0-9]{1,9})\])?\.?(?P<part>.*)\Z")


def find_port(system: CompiledSystem, text: str, option: str) -> Port:
    """Return the device that a name such as `left[1].device` means.

    Parameters
    ----------
    system
        The compiled scene.
    text, option
        The name, and where it was given.

    Raises
    ------
    ApcError
        E936 no such peer or part.
    """
    counts = [group.count for group in system.groups]
    starts = np.cumsum([0, *counts]).tolist()
    names = [group.name for group in system.groups]
    matched = _PORT.match(text)
    assert matched is not None
    group, number, own = matched["group"], matched["number"], matched["part"]
    if group is None:
        first, _, rest = own.partition(".")
        if first in names:
            group, number, own = first, "1", rest
    states = [state.name for kind in system.kinds for state in kind.states]
    parts = sorted({name.rpartition(".")[0] for name in states})
    parts += sorted({name for name in states if whole_and_index(name)[1]})  # an axis of one
    named = own if own in parts else "device" if "device" in parts else next(iter(parts), "device")
    example = f'{option} "{names[0]}[1].{named}"'
    if group is not None and group not in names:
        what = f"{option}: no group of peers is called {group[:40]}"
        hint = nearest(group, names)
        hint = f'{option} "{hint}[{number}].{named}"' if hint else example
        raise ApcError(Mistake("E936", Place(system.origin.topology), what, hint=hint))
    place = 0 if group is None else names.index(group)
    peer = int(number or 1)
    if not 1 <= peer <= counts[place]:
        example = f'{option} "{names[place]}[{counts[place]}].{named}"'
        what = f"{option}: {names[place]} has {counts[place]:,} peers, counted from 1; there is no {peer}"
        raise ApcError(Mistake("E936", Place(system.origin.topology), what, hint=example))
    if own and own not in parts:
        what = f"{option}: nothing that moves is called {own[:40]}"
        hint = f'{option} "{names[place]}[{peer}].{nearest(own, parts) or named}"'
        raise ApcError(Mistake("E936", Place(system.origin.topology), what, hint=hint))
    return Port(starts[place] + peer - 1, own)


@dataclass(frozen=True, slots=True, eq=False)
class _Modes:
    """A scene as modes of which any device may be pushed: that of all classes first, then each class apart.

    `bases` are the modes' rigid motions. A class is a site of the first: `apart` gives its own mode,
    `members` how many peers it stands for, `class_of` the class of a peer. `device` is what is pushed,
    `other` what else is looked at.
    """

    loops: tuple[Pushed, ...]
    bases: tuple[Floats, ...]
    apart: dict[int, int]
    class_of: dict[int, int]
    members: tuple[int, ...]
    device: Device
    other: Device


@part("feel")
def feel(
    system: CompiledSystem,
    frequencies: Sequence[float] | Floats,
    *,
    at: str = "",
    between: str = "",
    unstable: bool = False,
    quick: bool = False,
    prepared: Prepared | None = None,
) -> Feel:
    """Say what a hand feels.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    frequencies
        (k,), in Hz, above 0 and at most half the rate of the fastest clock.
    at, between
        The device that is pushed, and another whose motion is asked for: `left[1].device`. The first peer's,
        and the next one's, if not given.
    unstable
        Whether the map of an unstable scene is wanted, which has no response in time.
    quick
        Leave out what is told beside the responses.
    prepared
        From `analysis.prepare`, of this system with any numbers.

    Raises
    ------
    ApcError
        E931 a peer without a device; E934 an unstable scene; E935 a frequency beyond half the fastest clock,
        or none above 0; E936 a name that means nothing; E933 a scene too large.
    """
    found = np.asarray(frequencies, dtype=np.float64).ravel()
    port = find_port(system, at, "--at")
    other = find_port(system, between, "--between") if between else Port(_next(system, port), "")
    _check_frequencies(system, found)
    prepared = prepared or prepare(system)
    verdict = judge(system, prepared=prepared)
    if verdict.stable is False and not unstable:
        raise _unstable(system, verdict.spectral_radius)
    with single_threaded(), finite_equations(system.name), np.errstate(all="ignore"):
        modes, exchange = _modes(system, prepared, port, other)
        responses = _Responses(modes, port.peer, other.peer)
        s = np.asarray(2j * np.pi * found, dtype=np.complex128)
        own, *aliases, across, error = responses.steady(s, ALIASES)
        one = 1 / own[0]
        alias = np.max([np.abs(value) for value, _ in aliases], axis=0) / np.abs(own[0])
        bounds = [
            1.01 * off / np.where(value == 0, np.inf, np.abs(value)) for value, off in (own, across, error)
        ]
        steady = verdict.stable is not False and not quick
        slow = responses.slow() if not quick else None
        hinf = _extremes(modes, responses) if steady else ()
        h2 = _noise(system, modes, responses) if steady else ()
    linear = all(prepared.jacobians[group.kind].affine for group in system.groups)
    here, there = (
        f"{exchange.peer_name(one.peer)}.{device.part}"
        for one, device in ((port, modes.device), (other, modes.other))
    )
    notes = {
        "of the map: the scene is unstable": verdict.stable is False,
        "of slow motions nothing is told: something of the scene is slower still": not slow and not quick,
        "what noise does is not told: the fastest clock has a phase": steady and not h2,
    }
    return Feel(
        topology=system.name,
        at=here,
        between="" if there == here else there,
        copy=responses.copy,
        frequency_hz=found,
        impedance=one,
        transmitted_admittance=across[0],
        error_per_force=error[0],
        alias=alias,
        bound=bounds[0],
        transmitted_bound=bounds[1],
        error_bound=bounds[2],
        low_frequency=slow,
        hinf=hinf,
        h2=h2,
        stable=verdict.stable,
        linearized=not linear,
        left_out=left_out(system, linear=linear),
        notes=tuple(note for note, applies in notes.items() if applies),
    )


def _unstable(system: CompiledSystem, radius: float) -> ApcError:
    what = (
        f"the scene is unstable (spectral radius {radius:.6g}): what a push makes of it grows, and it has no "
        "response in time"
    )
    hint = "--unstable, for that of the map from force to motion"
    return ApcError(Mistake("E934", Place(system.origin.topology), what, hint=hint))


def read_frequencies(
    system: CompiledSystem, listed: str | None, low: str, high: str | None, points: int
) -> Floats:
    """Return the frequencies that options name, in Hz: those listed, or points between two at equal ratios.

    Parameters
    ----------
    system
        The compiled scene.
    listed
        Frequencies with units and commas between, or None.
    low, high, points
        From where to where, `HIGHEST` or half the fastest clock if not given, and how many.

    Raises
    ------
    ApcError
        E935 none above 0, or the lowest above the highest; those of `option_value`.
    """
    if listed is not None:
        texts = [one.strip() for one in listed.split(",") if one.strip()]
        values = [float(option_value("--frequencies", one, what="frequency", unit="Hz")) for one in texts]
        return np.array(values)
    first = float(option_value("--from", low, what="frequency", unit="Hz"))
    last = min(HIGHEST, fastest(system) / 2)
    if high is not None:
        last = float(option_value("--to", high, what="frequency", unit="Hz"))
    if not 0 < first < last:
        what = f"from {first:.6g} Hz to {last:.6g} Hz there is nothing above 0 Hz"
        hint = '--from "0.1 Hz" --to "60 Hz"'
        if first > 0 and high is None:
            what = f"{first:.6g} Hz is not below {last:.6g} Hz, where it ends without --to"
            hint = f'--from "{first:.6g} Hz" --to "{fastest(system) / 2:.6g} Hz"'
        raise ApcError(Mistake("E935", Place("--from"), what, hint=hint))
    return np.geomspace(first, last, points)


def fastest(system: CompiledSystem) -> float:
    """Return the rate of the fastest clock in Hz."""
    return float(1 / _fastest_clock(system)[0])


def _fastest_clock(system: CompiledSystem) -> tuple[Fraction, Fraction]:
    """Return the period and phase of the fastest clock that anything uses, in seconds."""
    timings = resolve(system).timings
    used = {part.clock for kind in system.kinds for part in kind.clocks} | {one.clock for one in system.links}
    clock = min((one for one in system.clocks if one.name in used), key=lambda one: timings[one.period])
    return timings[clock.period], timings[clock.phase]


def _next(system: CompiledSystem, port: Port) -> int:
    """Return the peer after one, itself if it is alone."""
    return (port.peer + 1) % sum(group.count for group in system.groups)


def _check_frequencies(system: CompiledSystem, found: Floats) -> None:
    """Refuse frequencies that no response is told of: ApcError E935."""
    most = fastest(system) / 2
    place = Place(system.origin.topology)
    hint = f"{most:.6g} Hz at most"
    if not found.size or not np.isfinite(found).all() or found.min() <= 0:
        got = "none" if not found.size else f"{found.min():.6g} Hz"
        raise ApcError(Mistake("E935", place, "a frequency", "above 0 Hz", got, '--from "0.1 Hz"'))
    if found.max() > most:
        what = f"{found.max():.6g} Hz is beyond half the fastest clock: samples take it for a slower one"
        raise ApcError(Mistake("E935", place, what, hint=hint))


def _modes(system: CompiledSystem, prepared: Prepared, port: Port, other: Port) -> tuple[_Modes, Exchange]:
    """Open all peers of a scene, and put them together to modes."""
    groups, exchange = lifted_groups(system, prepared=prepared)
    unit_of = {one.name: one.unit for one in system.parameters}
    opened, sites, held = [], {}, {}
    for group in groups:
        device = None
        for one in (other, port):
            if one.peer not in group.peers:
                continue
            along = port.peer in group.peers or whole_and_index(port.part)[1]
            named = one.part or (port.part if along else "")
            device = find_device(group.jacobians, group.parameters, unit_of, group.listening, part=named)
            if not isinstance(device, Device):
                what = device or f"{group.name} has no device"
                moving = [state.name for state in group.jacobians.kind.states]
                meant = next((n for n in moving if whole_and_index(n)[1] == 1 and n in what), "device")
                hint = f"--at with the part that is held, as {group.name}[1].{meant}" if device else OWN_MASS
                raise ApcError(Mistake("E931", Place(system.origin.topology), what, hint=hint))
            held[one] = device
        if device is None:
            device = find_device(group.jacobians, group.parameters, unit_of, group.listening)
        kicks = len(group.schedule.events) * len(group.site.a)
        if kicks > MOST_KICKS:
            what = f"a frame of {group.name} has too many events and states: {kicks:,} together"
            hint = f"{MOST_KICKS:,} at most"
            raise ApcError(Mistake("E933", Place(system.origin.topology), what, hint=hint))
        own, site = open_site(group, device if isinstance(device, Device) else None)
        opened.append(own)
        sites[id(own.schedule)] = site
    plain, wide = _arranged(system, groups, exchange), _arranged(system, opened, exchange)
    common = wide[0]
    if (states := sum(len(site.lifted.z_names) for site in common.sites)) > MOST_TOGETHER:
        what = f"{len(common.sites):,} peers that differ have {states:,} states and readings in a frame"
        hint = f"fewer peers that differ: {MOST_TOGETHER:,} at most"
        raise ApcError(Mistake("E933", Place(system.origin.topology), f"apc feel: {what}", hint=hint))
    class_of = {
        peer: place
        for place, site in enumerate(common.sites)
        for peer in (port.peer, other.peer)
        if peer in site.peers
    }
    counts = tuple(site.count if common.name == "common" else 1 for site in common.sites)
    loops = tuple(
        pushed_loop(loop, sites, counts if number == 0 else (1,)) for number, loop in enumerate(wide)
    )
    apart = {}
    for number, loop in enumerate(wide[1:], 1):
        for place, alike in enumerate(common.sites):
            if loop.sites[0].name == alike.name:
                apart[place] = number
    bases = tuple(find_rigid_modes(loop).basis for loop in plain)
    return _Modes(loops, bases, apart, class_of, counts, held[port], held[other]), exchange


def _arranged(system: CompiledSystem, groups: Sequence[PeerGroup], exchange: Exchange) -> tuple[Loop, ...]:
    """Return one loop of all classes of equal peers, and one of each class apart; or all peers in one."""
    first, *apart = arrange(groups, exchange).loops
    if first.name in ("common", "single") and _by_classes(first, apart):
        return first, *apart
    states = sum(group.count * len(group.lifted.z_names) for group in groups)
    if states > MOST_STATES:
        what = f"{exchange.peers:,} peers on such a graph make one system of {states:,} states and readings"
        hint = f"peers on complete graphs, or {MOST_STATES:,} in all"
        raise ApcError(Mistake("E933", Place(system.origin.topology), f"apc feel: {what}", hint=hint))
    return (dense_loop(groups, exchange),)


def _by_classes(common: Loop, apart: Sequence[Loop]) -> bool:
    """Say whether each other loop is all there is of one class apart: a ring has more of them, one a wave."""
    many = {site.name: site.count - 1 for site in common.sites}
    return all(len(loop.sites) == 1 and loop.multiplicity == many.get(loop.sites[0].name) for loop in apart)


@dataclass(frozen=True, slots=True)
class _Weights:
    """What a quantity of the pushed peer is over (site, state): of classes' means, and of its own apart."""

    common: dict[tuple[int, int], float]
    apart: dict[tuple[int, int], float]


class _Responses:
    """The answers to a push of one peer, put together from those of modes."""

    def __init__(self, modes: _Modes, peer: int, other: int) -> None:
        self.modes = modes
        self.peer, self.across = peer, other
        self.own, self.to = modes.class_of[peer], modes.class_of[other]
        self.device, self.other = modes.device, modes.other
        _, axis = whole_and_index(modes.device.part)
        self.copies = [_copy(site.group, axis) for site in modes.loops[0].sites]
        named = self.copies[self.own]
        self.copy = named[0] if named else ""

    def at(self, s: Complex, aliases: Sequence[int] = (0,)) -> list[Carried]:
        """Return the velocity here at each alias, the velocity there, and the copy's error (k,)."""
        common = self.modes.loops[0]
        n = self.modes.members[self.own]
        copies = [(place, one[1], 0) for place, one in enumerate(self.copies) if one]
        here, there, own = self.device.velocity, self.other.velocity, self.copies[self.own]
        wanted = [(self.own, here, alias) for alias in aliases]
        wanted = [*wanted, (self.to, there, 0), *copies]
        together = [_scaled(one, 1 / n) for one in spectra(common, self.own, wanted, s)]
        velocity, (across, *rest) = together[: len(aliases)], together[len(aliases) :]
        parts = dict(zip([place for place, _, _ in copies], rest, strict=True))
        apart: list[Carried] = []
        if n > 1:
            loop = self.modes.loops[self.modes.apart[self.own]]
            rows = [(0, here, alias) for alias in aliases]
            rows += ([(0, there, 0)] if self.own == self.to else []) + ([(0, own[1], 0)] if own else [])
            apart = spectra(loop, 0, rows, s)
            velocity = [add(a, _scaled(b, 1 - 1 / n)) for a, b in zip(velocity, apart, strict=False)]
            if self.own == self.to:
                share = 1 - 1 / n if self.peer == self.across else -1 / n
                across = add(across, _scaled(apart[len(aliases)], share))
        error = self._error(parts, apart[-1] if own and n > 1 else None, len(s))
        return [*velocity, across, error]

    def steady(self, s: Complex, aliases: Sequence[int]) -> list[Carried]:
        """Return the same on the imaginary axis, at multiples of the frame rate too.

        Notes
        -----
        There e^{sT} = 1, and where a scene may rest anywhere its equations of a frame say nothing, though the
        response has a value: the mean over a circle about s. Its mean against the direction is 0 if no pole
        is within.
        """
        turns = s.imag * float(self.modes.loops[0].frame) / (2 * np.pi)
        drifting = any(basis.size for basis in self.modes.bases)
        near = (np.abs(turns - np.round(turns)) < NEAR) & (turns > 0.5) & drifting
        found = [(np.zeros(len(s), complex), np.zeros(len(s))) for _ in range(len(aliases) + 2)]
        if not near.all():
            for (value, off), (own, doubt) in zip(found, self.at(s[~near], aliases), strict=True):
                value[~near], off[~near] = own, doubt
        around = ASIDE * np.exp(2j * np.pi * (np.arange(AROUND) + 0.5) / AROUND)
        for place in np.flatnonzero(near):
            circles = self.at(s[place] + np.concatenate([2 * around, around]), aliases)
            for (value, off), (own, doubt) in zip(found, circles, strict=True):
                inner = own[AROUND:]
                pole = abs((inner * around).mean()) / ASIDE
                value[place] = inner.mean()
                off[place] = abs(own[:AROUND].mean() - value[place]) + pole + doubt.max()
        return found

    @property
    def velocity_weights(self) -> _Weights:
        """What the velocity of the pushed peer is, in the modes."""
        one = {(self.own, self.device.velocity): 1.0}
        return _Weights(one, {(0, self.device.velocity): 1.0})

    @property
    def error_weights(self) -> _Weights | None:
        """What the error of the pushed peer's copy is, in the modes; None without any."""
        others = self._others()
        total = sum(others.values())
        own = self.copies[self.own]
        if own is None or not total:
            return None
        common = {(self.own, own[1]): 1.0}
        for place, many in others.items():
            copy = self.copies[place]
            assert copy is not None
            common[place, copy[1]] = common.get((place, copy[1]), 0.0) - many / total
        return _Weights(
            {key: weight for key, weight in common.items() if abs(weight) > UNIT},
            {(0, own[1]): 1 + 1 / total},
        )

    def _others(self) -> dict[int, int]:
        """Return how many others have a copy of the pushed peer's, class by class."""
        return {
            place: self.modes.members[place] - (place == self.own)
            for place, one in enumerate(self.copies)
            if one and one[0] == self.copy
        }

    def _error(self, parts: dict[int, Carried], apart: Carried | None, count: int) -> Carried:
        """Return how far the copy here is from the mean of all others' of its name."""
        others = self._others()
        total = sum(others.values())
        nothing = np.zeros(count, complex), np.zeros(count)
        if not total:
            return nothing
        found = parts[self.own]
        for place, many in others.items():
            found = add(found, _scaled(parts[place], -many / total))
        if apart is not None:
            # One peer less the mean of its class moves by 1 − 1/n here, and by −1/n at each of the others.
            n = self.modes.members[self.own]
            found = add(found, _scaled(apart, (1 - 1 / n) * (1 + 1 / total)))
        return found

    def slow(self) -> Slow | None:
        """Return mass, damping and stiffness at low frequency, None where they can't be told.

        Notes
        -----
        s Z(s) has no pole within a small circle about 0, so its Taylor coefficients are the means of its
        values on the circle against powers of s (Cauchy); those of two circles differ by what is left out.
        With a pole within, means against negative powers don't vanish.
        """
        before, radius = None, RADIUS
        best: Slow | None = None
        least = SETTLED
        for _ in range(HALVINGS):
            s = radius * np.exp(2j * np.pi * (np.arange(AROUND) + 0.5) / AROUND)
            (velocity, off), *_ = self.at(s)
            values, powers = s / velocity, radius ** np.arange(3)
            doubt = float((np.abs(values) * off / np.abs(velocity)).max())
            found = np.array([(values / s**power).mean().real for power in range(3)])
            if before is not None:
                inside = max(abs((values * (s / radius) ** power).mean()) for power in (1, 2, 3))
                off = np.abs(found - before) + (doubt + inside) / powers
                # At this speed, none matters that is far smaller than the largest.
                share = float((off * powers).max() / np.abs(found * powers).max())
                if share < least and inside <= DOUBTED * doubt:
                    least, (k, b, m), (off_k, off_b, off_m) = share, found.tolist(), off.tolist()
                    best = Slow(m, b, k, (off_m, off_b, off_k))
            before, radius = found, radius / 2
        return best


def _copy(group: PeerGroup, axis: int) -> tuple[str, int] | None:
    """Return what a peer tells others the position of, and which state that is; None if nothing.

    Of a position with several axes it is the one along that of the device, or 0 for the only one.
    """
    kind = group.jacobians.kind
    for send, sending in zip(group.site.sends, kind.sends, strict=True):
        for row, unit in zip(send.x, sending.units, strict=True):
            places = np.flatnonzero(row)
            if unit == "m" and len(places) == 1 and row[places[0]] == 1:
                place = int(places[0])
                if whole_and_index(kind.states[place].name)[1] == axis:
                    return kind.states[place].name.rpartition(".")[0], place
    return None


def _scaled(one: Carried, share: float) -> Carried:
    return one[0] * share, one[1] * abs(share) + 2 * UNIT * np.abs(one[0] * share)


def _extremes(modes: _Modes, responses: _Responses) -> tuple[Extremes, ...]:
    """Return the H∞ norms of the modes that the pushed peer is in."""
    found = []
    for number in (0, modes.apart.get(responses.own)):
        if number is None:
            continue
        loop, basis = modes.loops[number], modes.bases[number]
        site = 0 if number else responses.own
        rows = [("velocity", responses.device.velocity)]
        copy = responses.copies[responses.own]
        if number and copy is not None:
            rows.append(("error", copy[1]))
        for name, row in rows:
            peaks = (one(loop, site, site, row, basis) for one in (tick_peak, sampled_data_peak))
            found.append(Extremes(loop.name, name, *peaks))
    return tuple(found)


def _noise(system: CompiledSystem, modes: _Modes, responses: _Responses) -> tuple[Noise, ...]:
    """Return what white noise at all peers does to the pushed peer."""
    ticks = _ticks(system, float(modes.loops[0].frame))
    if ticks is None:
        return ()
    found = []
    for source, sensors in (("hands", False), ("sensors", True)):
        velocity = _variance(modes, responses, ticks, responses.velocity_weights, sensors=sensors)
        error = _variance(modes, responses, ticks, responses.error_weights, sensors=sensors)
        found.append(Noise(source, *(None if one is None else one**0.5 for one in (error, velocity))))
    return tuple(found)


def _variance(
    modes: _Modes, responses: _Responses, ticks: list[Fraction], weights: _Weights | None, *, sensors: bool
) -> float | None:
    """Return the variance of states of the pushed peer, each class's noise its own at each of its peers."""
    if weights is None:
        return None
    total = 0.0
    loop, basis = modes.loops[0], modes.bases[0]
    held = [place for place, site in enumerate(loop.sites) if site.device is not None]
    if weights.common:
        sources = {place: 1 / modes.members[place] for place in held}
        found = noise_variance(loop, ticks, sources, weights.common, basis, sensors=sensors)
        if found is None:
            return None
        total += found
    number = modes.apart.get(responses.own)
    if number is not None and weights.apart:
        sources = {0: 1 - 1 / modes.members[responses.own]}
        found = noise_variance(
            modes.loops[number], ticks, sources, weights.apart, modes.bases[number], sensors=sensors
        )
        if found is None:
            return None
        total += found
    return total


def _ticks(system: CompiledSystem, frame: float) -> list[Fraction] | None:
    """Return when in a frame the fastest clock ticks, None where a frame does not begin with a tick."""
    period, phase = _fastest_clock(system)
    if phase % period:
        return None
    return [number * period for number in range(round(frame / float(period)))]
