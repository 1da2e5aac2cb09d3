"""How peers answer a push at one of them, put together from the answers of modes.

Takes: a `CompiledSystem` with what `analysis.prepare` made of it, and two devices.
Gives: `AbstractResponses`; `many_differ`; `Modes`, `open_modes`; `Responses`, `Weights`; `held_device`,
`held_names`, `check_kicks`, `copy_of`, `nothing`.
Guarantees: an answer is exact for the sampled, held and sent signals of the scene, with a bound on its
rounding.
Does not: ask whether the scene is stable.

Peers' answers are put together from those of modes: with all n peers of a class alike, or one against their
mean, a push at one of them is 1/n of the first and 1 − 1/n of the second.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, lifted_groups, timed
from apc.analysis.plan import not_populations
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.language.vectors import whole_and_index
from apc.eigen.closing import Loop
from apc.eigen.modes import arrange, dense_loop
from apc.eigen.peers import MOST_STATES, PeerGroup, more_differ, states_of, used_ways
from apc.eigen.rigid import find_rigid_modes
from apc.frame.devices import OWN_MASS, Device, coupled_directly, find_device, find_devices
from apc.frame.discretize import UNIT
from apc.frame.exchange import Exchange, build_exchange
from apc.frame.parameters import resolve
from apc.frame.schedule import Propagate
from apc.hands.asked import Port
from apc.hands.response import Carried, Pushed, add, open_site, pushed_loop, scaled, spectra

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Turns a frame, so near a whole number of which a scene that may rest anywhere is asked around a frequency,
# how far around, in 1/s, and at how many points.
NEAR, ASIDE, AROUND = 1e-5, 0.25, 16

# States and readings of all kinds of peers together, in one matrix.
MOST_TOGETHER = 2000

# Intervals of a peer times its states, of what is kicked and read in a frame.
MOST_KICKS = 4000


@dataclass(frozen=True, slots=True, eq=False)
class Modes:
    """A scene as modes of which any device may be pushed: that of all classes first, then each class apart.

    `plain` are the modes of the scene as it is. A class is a site of the first: `apart` gives its own mode,
    `members` how many peers it stands for, `class_of` the class of a peer. `device` is what is pushed,
    `other` what else is looked at.
    """

    loops: tuple[Pushed, ...]
    plain: tuple[Loop, ...]
    apart: dict[int, int]
    class_of: dict[int, int]
    members: tuple[int, ...]
    device: Device
    other: Device


def many_differ(system: CompiledSystem, prepared: Prepared) -> bool:
    """Say whether more peers differ than one system holds, and all are linear and hear all others.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `analysis.prepare` made of it.
    """
    numbers = resolve(system)
    prepared = timed(system, prepared, numbers)
    exchange = build_exchange(system, numbers.timings)
    ways = used_ways(prepared.schedules)
    if not_populations(system, prepared.jacobians) or not all(exchange.is_complete(one.link) for one in ways):
        return False
    largest = 1
    for group, schedule in zip(system.groups, prepared.schedules, strict=True):
        kind = system.kinds[group.kind]
        each = 2 * len(kind.states) + 1 + len(kind.holds)  # what is kicked and read of an interval
        intervals = sum(isinstance(event, Propagate) for event in schedule.events)
        largest = max(largest, states_of(schedule, prepared.jacobians[group.kind]) + each * intervals)
    return more_differ(system, prepared.jacobians, numbers, exchange, max(1, MOST_TOGETHER // largest))


def open_modes(system: CompiledSystem, prepared: Prepared, port: Port, other: Port) -> tuple[Modes, Exchange]:
    """Open all peers of a scene, and put them together to modes."""
    groups, exchange = lifted_groups(system, prepared=prepared)
    unit_of = {one.name: one.unit for one in system.parameters}
    direct = coupled_directly(system.kinds)
    opened, sites, held = [], {}, {}
    for group in groups:
        device = None
        for one in (other, port):
            if one.peer not in group.peers:
                continue
            along = port.peer in group.peers or whole_and_index(port.part)[1]
            named = one.part or (port.part if along else "")
            held[one] = device = held_device(system, prepared, group, named, unit_of)
        if device is None:
            found = find_device(group.jacobians, group.parameters, unit_of, group.listening, direct=direct)
            device = found if isinstance(found, Device) else None
        check_kicks(system, group)
        own, site = open_site(group, device)
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
    return Modes(loops, plain, apart, class_of, counts, held[port], held[other]), exchange


def held_device(
    system: CompiledSystem, prepared: Prepared, group: PeerGroup, part: str, unit_of: Mapping[str, str]
) -> Device:
    """Return the device of a group that a hand holds, or refuse it.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `analysis.prepare` made of it.
    group
        The group, lifted.
    part
        What is held of its peers; the only device there is, if not given.
    unit_of
        Units of the parameters.

    Raises
    ------
    ApcError
        E931 no device, or none that can be told.
    """
    direct = coupled_directly(system.kinds)
    device = find_device(
        group.jacobians, group.parameters, unit_of, group.listening, part=part, direct=direct
    )
    if isinstance(device, Device):
        return device
    what = device or f"{group.name} has no device"
    names = held_names(system, prepared)
    own = [name for name in names if name.startswith(f"{group.name}[")]
    hint = f'--at "{(own or names)[0]}"' if names else "" if device else OWN_MASS
    raise ApcError(Mistake("E931", Place(system.origin.topology), what, hint=hint))


def held_names(system: CompiledSystem, prepared: Prepared) -> list[str]:
    """Return what hands may hold, of the first peer of each group: `left[1].device`."""
    unit_of, numbers = {one.name: one.unit for one in system.parameters}, resolve(system)
    direct = coupled_directly(system.kinds)
    return [
        f"{group.name}[1].{part}"
        for place, group in enumerate(system.groups)
        for part, found in find_devices(
            prepared.jacobians[group.kind], numbers.parameters[place][0], unit_of, direct=direct
        ).items()
        if isinstance(found, Device)
    ]


def check_kicks(system: CompiledSystem, group: PeerGroup) -> None:
    """Refuse a peer of too many events and states in a frame: ApcError E933."""
    kicks = len(group.schedule.events) * len(group.site.a)
    if kicks > MOST_KICKS:
        what = f"a frame of {group.name} has too many events and states: {kicks:,} together"
        hint = f"{MOST_KICKS:,} at most"
        raise ApcError(Mistake("E933", Place(system.origin.topology), what, hint=hint))


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
class Weights:
    """What a quantity of the pushed peer is over (site, state): of classes' means, and of its own apart."""

    common: dict[tuple[int, int], float]
    apart: dict[tuple[int, int], float]


class AbstractResponses(ABC):
    """The answers to a push of one peer's `device`: its own, and what of it arrives at the `other` device.

    `copy` is what of the peer others are told of, "" if nothing; `exchange` are the links, `frame` is in s;
    `drifting` says that the scene may rest anywhere.
    """

    exchange: Exchange
    device: Device
    other: Device
    copy: str
    frame: float
    drifting: bool

    @abstractmethod
    def at(self, s: Complex, aliases: Sequence[int] = (0,), *, apart: bool = True) -> list[Carried]:
        """Return the velocity here at each alias, the velocity there, and the copy's error (k,).

        The last is 0 unless it is asked how far copies are `apart`.
        """

    def steady(self, s: Complex, aliases: Sequence[int]) -> list[Carried]:
        """Return the same on the imaginary axis, at multiples of the frame rate too.

        Notes
        -----
        There e^{sT} = 1, and where a scene may rest anywhere its equations of a frame say nothing, though the
        response has a value: the mean over a circle about s. Its mean against the direction is 0 if no pole
        is within.
        """
        turns = s.imag * self.frame / (2 * np.pi)
        near = (np.abs(turns - np.round(turns)) < NEAR) & (turns > 0.5)
        near = near & self.drifting if near.any() else near
        found = [nothing(s) for _ in range(len(aliases) + 2)]
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


class Responses(AbstractResponses):
    """The answers to a push of one peer, put together from those of modes."""

    def __init__(self, modes: Modes, exchange: Exchange, peer: int, other: int) -> None:
        self.modes, self.exchange = modes, exchange
        self.peer, self.across = peer, other
        self.own, self.to = modes.class_of[peer], modes.class_of[other]
        self.device, self.other = modes.device, modes.other
        self.copies = [copy_of(site.group, modes.device) for site in modes.loops[0].sites]
        named = self.copies[self.own]
        self.copy = named[0] if named else ""
        self.frame = float(modes.loops[0].frame)

    @functools.cached_property
    def bases(self) -> tuple[Floats, ...]:
        """The rigid motions of each mode."""
        return tuple(find_rigid_modes(loop).basis for loop in self.modes.plain)

    @functools.cached_property
    def drifting(self) -> bool:  # type: ignore[override]  # asked for only at multiples of the frame rate
        """Whether the scene may rest anywhere."""
        return any(basis.size for basis in self.bases)

    def at(self, s: Complex, aliases: Sequence[int] = (0,), *, apart: bool = True) -> list[Carried]:
        """Return the velocity here at each alias, the velocity there, and the copy's error (k,)."""
        common = self.modes.loops[0]
        n = self.modes.members[self.own]
        copies = [(place, one[1], 0) for place, one in enumerate(self.copies) if one and apart]
        here, there, own = self.device.velocity, self.other.velocity, self.copies[self.own]
        wanted = [(self.own, here, alias) for alias in aliases]
        wanted = [*wanted, (self.to, there, 0), *copies]
        together = [scaled(one, 1 / n) for one in spectra(common, self.own, wanted, s)]
        velocity, (across, *rest) = together[: len(aliases)], together[len(aliases) :]
        parts = dict(zip([place for place, _, _ in copies], rest, strict=True))
        alone: list[Carried] = []
        if n > 1:
            loop = self.modes.loops[self.modes.apart[self.own]]
            rows = [(0, here, alias) for alias in aliases]
            rows += [(0, there, 0)] if self.own == self.to else []
            rows += [(0, own[1], 0)] if own and apart else []
            alone = spectra(loop, 0, rows, s)
            velocity = [add(a, scaled(b, 1 - 1 / n)) for a, b in zip(velocity, alone, strict=False)]
            if self.own == self.to:
                share = 1 - 1 / n if self.peer == self.across else -1 / n
                across = add(across, scaled(alone[len(aliases)], share))
        error = self._error(parts, alone[-1] if own and n > 1 else None, s) if apart else nothing(s)
        return [*velocity, across, error]

    @property
    def velocity_weights(self) -> Weights:
        """What the velocity of the pushed peer is, in the modes."""
        one = {(self.own, self.device.velocity): 1.0}
        return Weights(one, {(0, self.device.velocity): 1.0})

    @property
    def error_weights(self) -> Weights | None:
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
        return Weights(
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

    def _error(self, parts: dict[int, Carried], apart: Carried | None, s: Complex) -> Carried:
        """Return how far the copy here is from the mean of all others' of its name."""
        others = self._others()
        total = sum(others.values())
        if not total:
            return nothing(s)
        found = parts[self.own]
        for place, many in others.items():
            found = add(found, scaled(parts[place], -many / total))
        if apart is not None:
            # One peer less the mean of its class moves by 1 − 1/n here, and by −1/n at each of the others.
            n = self.modes.members[self.own]
            found = add(found, scaled(apart, (1 - 1 / n) * (1 + 1 / total)))
        return found


def copy_of(group: PeerGroup, device: Device) -> tuple[str, int] | None:
    """Return what a peer tells others the position of, and which state that is; None if nothing.

    Of a position with several axes it is the one along that of the device that is pushed.
    """
    _, axis = whole_and_index(device.part)
    kind = group.jacobians.kind
    for send, sending in zip(group.site.sends, kind.sends, strict=True):
        for row, unit in zip(send.x, sending.units, strict=True):
            places = np.flatnonzero(row)
            if unit == "m" and len(places) == 1 and row[places[0]] == 1:
                place = int(places[0])
                if whole_and_index(kind.states[place].name)[1] == axis:
                    return kind.states[place].name.rpartition(".")[0], place
    return None


def nothing(s: Complex) -> Carried:
    """Return 0 at each s (k,)."""
    return np.zeros(len(s), np.complex128), np.zeros(len(s))
