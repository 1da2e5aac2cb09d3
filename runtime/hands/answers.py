"""How peers answer a push at one of them, put together from the answers of modes.

Takes: a `Model` with what `instance.prepare` made of it, and two devices.
Gives: `Responses`, `responses`; `Weights`; `held_names`.
Guarantees: an answer is exact for the sampled, held and sent signals of the scene, with a bound on its
rounding.
Does not: ask whether the scene is stable.

Peers' answers are put together from those of modes: with all n peers of a class alike, or one against their
mean, a push at one of them is 1/n of the first and 1 − 1/n of the second.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.language.vectors import whole_and_index
from apc.eigen.closing import ModalSystem
from apc.eigen.modes import arrange, dense_loop
from apc.eigen.peers import MOST_STATES, PeerClass
from apc.eigen.rigid import find_rigid_modes
from apc.frame.devices import OWN_MASS, Device, coupled_directly, find_device, find_devices
from apc.frame.exchange import CommunicationGraph
from apc.frame.instance import Prepared
from apc.frame.parameters import resolve
from apc.frame.radius import RADII, UNIT, with_radius
from apc.hands.asked import DevicePort
from apc.hands.response import DrivenMode, open_site, pushed_loop, spectra

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
Matrix = NDArray[Any]

# Numbers (k,) with what they may be off by.
Carried = tuple[Complex, Floats]

# Turns a frame, so near a whole number of which a scene that may rest anywhere is asked around a frequency,
# how far around, in 1/s, and at how many points.
NEAR, ASIDE, AROUND = 1e-5, 0.25, 16

# States and readings of all kinds of peers together, in one matrix.
MOST_TOGETHER = 2000

# Intervals of a peer times its states, of what is kicked and read in a frame.
MOST_KICKS = 4000


def responses(system: Model, prepared: Prepared, port: DevicePort, other: DevicePort) -> Responses:
    """Return the answers to a push of one device, at it and at another.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `instance.prepare` made of it.
    port, other
        The two devices.

    Raises
    ------
    ApcError
        E931 a peer without a device; E933 a scene too large.
    """
    groups, exchange = lifted_groups(system, prepared=prepared)
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    direct = coupled_directly(system.kinds)
    opened, sites, held = [], {}, {}
    for group in groups:
        device = None
        for item in (other, port):
            if item.peer not in group.peers:
                continue
            along = port.peer in group.peers or whole_and_index(port.part)[1]
            named = item.part or (port.part if along else "")
            held[item] = device = _held_device(system, prepared, group, named, unit_of)
        if device is None:
            result = find_device(group.jacobians, group.parameters, unit_of, group.listening, direct=direct)
            device = result if isinstance(result, Device) else None
        _check_kicks(system, group)
        peer_group, site = open_site(group, device)
        opened.append(peer_group)
        sites[id(peer_group.schedule)] = site
    plain, wide = _arranged(system, groups, exchange), _arranged(system, opened, exchange)
    common = wide[0]
    if (states := sum(len(site.z_names) for site in common.sites)) > MOST_TOGETHER:
        what = f"{len(common.sites):,} peers that differ have {states:,} states and readings in a frame"
        hint = f"fewer peers that differ: {MOST_TOGETHER:,} at most"
        raise ApcError(
            Diagnostic("E933", SourceLocation(system.origin.topology), f"apc feel: {what}", hint=hint)
        )
    here, there = (
        next(place for place, site in enumerate(common.sites) if item.peer in site.peers)
        for item in (port, other)
    )
    name = common.sites[here].name
    apart = [number for number, loop in enumerate(wide) if number and loop.sites[0].name == name]
    return Responses(
        exchange=exchange,
        device=held[port],
        other=held[other],
        loops=tuple(pushed_loop(loop, sites) for loop in wide),
        plain=plain,
        members=tuple(site.count for site in common.sites),
        own=here,
        to=there,
        alone=apart[0] if apart else None,
        same=port.peer == other.peer,
    )


def _held_device(
    system: Model, prepared: Prepared, group: PeerClass, part: str, unit_of: Mapping[str, str]
) -> Device:
    """Return the device of a group that a hand holds, the only one if no part is named; or refuse it."""
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
    raise ApcError(Diagnostic("E931", SourceLocation(system.origin.topology), what, hint=hint))


def held_names(system: Model, prepared: Prepared) -> list[str]:
    """Return what hands may hold, of the first peer of each group: `left[1].device`."""
    unit_of, numbers = {parameter.name: parameter.unit for parameter in system.parameters}, resolve(system)
    direct = coupled_directly(system.kinds)
    return [
        f"{group.name}[1].{part}"
        for place, group in enumerate(system.groups)
        for part, result in find_devices(
            prepared.jacobians[group.kind], numbers.parameters[place][0], unit_of, direct=direct
        ).items()
        if isinstance(result, Device)
    ]


def _check_kicks(system: Model, group: PeerClass) -> None:
    """Refuse a peer of too many events and states in a frame: ApcError E933."""
    kicks = len(group.schedule.events) * len(group.site.a)
    if kicks > MOST_KICKS:
        what = f"a frame of {group.name} has too many events and states: {kicks:,} together"
        hint = f"{MOST_KICKS:,} at most"
        raise ApcError(Diagnostic("E933", SourceLocation(system.origin.topology), what, hint=hint))


def _arranged(
    system: Model, groups: Sequence[PeerClass], exchange: CommunicationGraph
) -> tuple[ModalSystem, ...]:
    """Return one loop of all classes of equal peers, and one of each class apart; or all peers in one."""
    arranged = arrange(groups, exchange)
    first, *apart = arranged.loops
    if arranged.method == "modes" and _by_classes(first, apart):
        return first, *apart
    states = sum(group.count * len(group.z_names) for group in groups)
    if states > MOST_STATES:
        what = f"{exchange.peers:,} peers on such a graph make one system of {states:,} states and readings"
        hint = f"peers on complete graphs, or {MOST_STATES:,} in all"
        raise ApcError(
            Diagnostic("E933", SourceLocation(system.origin.topology), f"apc feel: {what}", hint=hint)
        )
    return (dense_loop(groups, exchange),)


def _by_classes(common: ModalSystem, apart: Sequence[ModalSystem]) -> bool:
    """Say whether each other loop is all there is of one class apart: a ring has more of them, one a wave."""
    many = {site.name: site.count - 1 for site in common.sites}
    return all(len(loop.sites) == 1 and loop.multiplicity == many.get(loop.sites[0].name) for loop in apart)


# What a quantity of a peer is over (site, state): of classes' means, and of how it differs from its own's.
Weights = tuple[Mapping[tuple[int, int], float], Mapping[tuple[int, int], float]]


@dataclass(frozen=True, eq=False)
class Responses:
    """The answers to a push of one peer's `device`: its own, and what of it arrives at the `other` device.

    They are put together from those of modes: `loops`, that of all classes first, then each class apart;
    `plain` are the same of the scene as it is. A class is a site of the first, of which `members` says how
    many peers it stands for; `own` is that of the pushed peer, `alone` its mode apart, if there is one, `to`
    that of the other, `same` whether both are one peer. `exchange` are the links.
    """

    exchange: CommunicationGraph
    device: Device
    other: Device
    loops: tuple[DrivenMode, ...]
    plain: tuple[ModalSystem, ...]
    members: tuple[int, ...]
    own: int
    to: int
    alone: int | None
    same: bool

    @functools.cached_property
    def copies(self) -> list[tuple[str, int] | None]:
        """What a peer of each class tells others the position of, and which state that is."""
        return [_copy_of(site.group, self.device) for site in self.loops[0].sites]

    @property
    def copy(self) -> str:
        """What of the pushed peer others are told of, "" if nothing."""
        own = self.copies[self.own]
        return own[0] if own else ""

    @property
    def frame(self) -> float:
        """How long a frame is, in s."""
        return float(self.loops[0].frame)

    @property
    def parts(self) -> list[tuple[int, int, float]]:
        """The modes of the pushed peer: which, at which site, and how much of a push at it each gets."""
        n = self.members[self.own]
        common = (0, self.own, 1 / n)
        return [common] if self.alone is None else [common, (self.alone, 0, 1 - 1 / n)]

    @functools.cached_property
    def bases(self) -> tuple[Floats, ...]:
        """The rigid motions of each mode."""
        return tuple(find_rigid_modes(loop).basis for loop in self.plain)

    @functools.cached_property
    def drifting(self) -> bool:
        """Whether the scene may rest anywhere."""
        return any(basis.size for basis in self.bases)

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
        pairs = [(np.zeros(len(s), np.complex128), np.zeros(len(s))) for _ in range(len(aliases) + 2)]
        if not near.all():
            for (value, off), (own, doubt) in zip(pairs, self.at(s[~near], aliases), strict=True):
                value[~near], off[~near] = own, doubt
        around = ASIDE * np.exp(2j * np.pi * (np.arange(AROUND) + 0.5) / AROUND)
        for place in np.flatnonzero(near):
            circles = self.at(s[place] + np.concatenate([2 * around, around]), aliases)
            for (value, off), (own, doubt) in zip(pairs, circles, strict=True):
                inner = own[AROUND:]
                pole = abs((inner * around).mean()) / ASIDE
                value[place] = inner.mean()
                off[place] = abs(own[:AROUND].mean() - value[place]) + pole + doubt.max()
        return pairs

    def at(self, s: Complex, aliases: Sequence[int] = (0,), *, apart: bool = True) -> list[Carried]:
        """Return the velocity here at each alias, the velocity there, and the copy's error (k,).

        The last is 0 unless it is asked how far copies are `apart`.
        """
        asked = [(self.velocity, alias) for alias in aliases]
        asked += [(self.arriving, 0), (self.error if apart else ({}, {}), 0)]
        matrices: list[Matrix] = [np.zeros((len(s), 2, 1, 1), np.complex128) for _ in asked]
        for part, (number, site, share) in enumerate(self.parts):
            rows = [
                (of, (*place, alias), weight)
                for of, (weights, alias) in enumerate(asked)
                for place, weight in weights[part].items()
            ]
            moved = spectra(self.loops[number], site, [row for _, row, _ in rows], s)
            for (of, _, weight), matrix in zip(rows, moved, strict=True):
                by = np.array([[weight * share]])
                matrices[of] = RADII.add(
                    matrices[of], RADII.multiply(matrix, with_radius(by, 8 * UNIT * np.abs(by)))
                )
        return [(matrix[:, 0, 0, 0], matrix[:, 1, 0, 0].real) for matrix in matrices]

    @property
    def velocity(self) -> Weights:
        """What the velocity of the pushed device is."""
        return {(self.own, self.device.velocity): 1.0}, {(0, self.device.velocity): 1.0}

    @property
    def arriving(self) -> Weights:
        """What the velocity of the other device is: peers of a class differ from their mean by 0 in all."""
        share = 1.0 if self.same else 1 / (1 - self.members[self.own]) if self.own == self.to else 0.0
        apart = {(0, self.other.velocity): share} if share else {}
        return {(self.to, self.other.velocity): 1.0}, apart

    @property
    def error(self) -> Weights:
        """How far the pushed peer's copy is from the mean of all others' of its name; nothing if none."""
        pushed = self.copies[self.own]
        others = {
            (place, copy[1]): self.members[place] - (place == self.own)
            for place, copy in enumerate(self.copies)
            if pushed and copy and copy[0] == pushed[0]
        }
        total = sum(others.values())
        if pushed is None or not total:
            return {}, {}
        common = {place: (place[0] == self.own) - many / total for place, many in others.items()}
        return {place: weight for place, weight in common.items() if abs(weight) > UNIT}, {
            (0, pushed[1]): 1 + 1 / total
        }


def _copy_of(group: PeerClass, device: Device) -> tuple[str, int] | None:
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
