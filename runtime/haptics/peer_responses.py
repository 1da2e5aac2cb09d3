"""Frequency responses of peers to a force on one device, composed of the responses of modes.

Takes: a `Model` with the result of `numeric_model.prepare` for it, and two devices.
Gives: `Responses`, `responses`; `Weights`; `gripped_names`.
Guarantees: a response is exact for the sampled, held and sent signals of the model, with a bound on its
rounding.
Does not: check the stability of the model.

The response of a peer is a sum over modes: with all n peers of a class in phase, or one against their mean, a
force on one of them has the share 1/n in the first and 1 − 1/n in the second.
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
from apc.eigen.interconnection import ModalSystem
from apc.eigen.modes import decompose, dense_loop
from apc.eigen.peer_classes import MOST_STATES, PeerClass
from apc.eigen.rigid_modes import find_rigid_modes
from apc.frame.communication_graph import CommunicationGraph
from apc.frame.devices import LOCAL_MASS, Device, coupled_directly, find_device, find_devices
from apc.frame.interval_arithmetic import MIDPOINT_RADIUS, UNIT_ROUNDOFF, with_error_radius
from apc.frame.numeric_model import Prepared
from apc.frame.parameters import resolve
from apc.haptics.device_port import DevicePort
from apc.haptics.modal_response import DrivenMode, driven_mode, driven_subsystem, spectra

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
Matrix = NDArray[Any]

# Numbers (k,) with their error bounds.
Carried = tuple[Complex, Floats]

# The distance from an integer number of cycles per frame at which a model with rigid modes is evaluated on a
# circle around the frequency; the radius of the circle in 1/s, and its number of points.
NEAR, ASIDE, AROUND = 1e-5, 0.25, 16

# The limit of states and readings of all peer types together, in one matrix.
MOST_TOGETHER = 2000

# The limit of intervals times states of a peer: the forced increments and readings in a frame.
MOST_INCREMENTS = 4000


def responses(system: Model, prepared: Prepared, port: DevicePort, other: DevicePort) -> Responses:
    """Return the responses to a force on one device, at that device and at another.

    Parameters
    ----------
    system, prepared
        The compiled model, and the result of `numeric_model.prepare` for it.
    port, other
        The two devices.

    Raises
    ------
    ApcError
        E931 a peer without a device; E933 a model too large.
    """
    groups, exchange = lifted_groups(system, prepared=prepared)
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    direct = coupled_directly(system.peer_types)
    opened, subsystems, gripped = [], {}, {}
    for group in groups:
        device = None
        for item in (other, port):
            if item.peer not in group.peers:
                continue
            along = port.peer in group.peers or whole_and_index(port.part)[1]
            named = item.part or (port.part if along else "")
            gripped[item] = device = _gripped_device(system, prepared, group, named, unit_of)
        if device is None:
            result = find_device(
                group.jacobians, group.parameters, unit_of, group.initial_reception, direct=direct
            )
            device = result if isinstance(result, Device) else None
        _check_increments(system, group)
        peer_group, subsystem = driven_subsystem(group, device)
        opened.append(peer_group)
        subsystems[id(peer_group.schedule)] = subsystem
    plain, wide = _arranged(system, groups, exchange), _arranged(system, opened, exchange)
    common = wide[0]
    if (states := sum(len(subsystem.z_names) for subsystem in common.subsystems)) > MOST_TOGETHER:
        message = (
            f"{len(common.subsystems):,} peers that differ have {states:,} states and readings in a frame"
        )
        hint = f"fewer peers that differ: {MOST_TOGETHER:,} at most"
        raise ApcError(
            Diagnostic(
                "E933", SourceLocation(system.origin.topology), f"apc transparency: {message}", hint=hint
            )
        )
    here, there = (
        next(index for index, subsystem in enumerate(common.subsystems) if item.peer in subsystem.peers)
        for item in (port, other)
    )
    name = common.subsystems[here].name
    difference_loops = [
        number for number, loop in enumerate(wide) if number and loop.subsystems[0].name == name
    ]
    return Responses(
        exchange=exchange,
        device=gripped[port],
        other=gripped[other],
        loops=tuple(driven_mode(loop, subsystems) for loop in wide),
        plain=plain,
        members=tuple(subsystem.count for subsystem in common.subsystems),
        local=here,
        to=there,
        unpaired=difference_loops[0] if difference_loops else None,
        same=port.peer == other.peer,
    )


def _gripped_device(
    system: Model, prepared: Prepared, group: PeerClass, part: str, unit_of: Mapping[str, str]
) -> Device:
    """Return the device of a group, the only one if no part is named, or raise an error."""
    direct = coupled_directly(system.peer_types)
    device = find_device(
        group.jacobians, group.parameters, unit_of, group.initial_reception, part=part, direct=direct
    )
    if isinstance(device, Device):
        return device
    message = device or f"{group.name} has no device"
    names = gripped_names(system, prepared)
    local = [name for name in names if name.startswith(f"{group.name}[")]
    hint = f'--at "{(local or names)[0]}"' if names else "" if device else LOCAL_MASS
    raise ApcError(Diagnostic("E931", SourceLocation(system.origin.topology), message, hint=hint))


def gripped_names(system: Model, prepared: Prepared) -> list[str]:
    """Return the labels of the possible devices, for the first peer of each group: `left[1].device`."""
    unit_of, numbers = {parameter.name: parameter.unit for parameter in system.parameters}, resolve(system)
    direct = coupled_directly(system.peer_types)
    return [
        f"{group.name}[1].{part}"
        for index, group in enumerate(system.groups)
        for part, result in find_devices(
            prepared.jacobians[group.peer_type], numbers.parameters[index][0], unit_of, direct=direct
        ).items()
        if isinstance(result, Device)
    ]


def _check_increments(system: Model, group: PeerClass) -> None:
    """Raise ApcError E933 for a peer of too many events and states in a frame."""
    forced_increments = len(group.schedule.events) * len(group.subsystem.a)
    if forced_increments > MOST_INCREMENTS:
        message = f"a frame of {group.name} has too many events and states: {forced_increments:,} together"
        hint = f"{MOST_INCREMENTS:,} at most"
        raise ApcError(Diagnostic("E933", SourceLocation(system.origin.topology), message, hint=hint))


def _arranged(
    system: Model, groups: Sequence[PeerClass], exchange: CommunicationGraph
) -> tuple[ModalSystem, ...]:
    """Return one loop of all classes of equal peers, and one difference loop each; or one of all."""
    decomposed = decompose(groups, exchange)
    first, *difference_loops = decomposed.loops
    if decomposed.method == "modes" and _by_classes(first, difference_loops):
        return first, *difference_loops
    states = sum(group.count * len(group.z_names) for group in groups)
    if states > MOST_STATES:
        message = (
            f"{exchange.peers:,} peers on such a graph make one system of {states:,} states and readings"
        )
        hint = f"peers on complete graphs, or {MOST_STATES:,} in all"
        raise ApcError(
            Diagnostic(
                "E933", SourceLocation(system.origin.topology), f"apc transparency: {message}", hint=hint
            )
        )
    return (dense_loop(groups, exchange),)


def _by_classes(common: ModalSystem, difference_loops: Sequence[ModalSystem]) -> bool:
    """Return whether the other loops are one difference loop per class; a ring has others."""
    many = {subsystem.name: subsystem.count - 1 for subsystem in common.subsystems}
    return all(
        len(loop.subsystems) == 1 and loop.multiplicity == many.get(loop.subsystems[0].name)
        for loop in difference_loops
    )


# A quantity of a peer over (subsystem, state): of class means, and of its difference from the mean of its
# class.
Weights = tuple[Mapping[tuple[int, int], float], Mapping[tuple[int, int], float]]


@dataclass(frozen=True, eq=False)
class Responses:
    """The responses to a force on one peer's `device`: its own, and that of the `other` device.

    They are sums over the responses of modes: `loops`, that of all classes first, then the difference loop of
    each class; `plain` are the same of the model without inputs. A class is a subsystem of the first loop,
    and represents `members` peers; `local` is that of the driven peer, `unpaired` its difference mode, if
    there is one, `to` that of the other, `same` whether both are one peer. `exchange` are the links.
    """

    exchange: CommunicationGraph
    device: Device
    other: Device
    loops: tuple[DrivenMode, ...]
    plain: tuple[ModalSystem, ...]
    members: tuple[int, ...]
    local: int
    to: int
    unpaired: int | None
    same: bool

    @functools.cached_property
    def copies(self) -> list[tuple[str, int] | None]:
        """The quantity whose position each class sends, and the index of that state."""
        return [_copy_of(subsystem.group, self.device) for subsystem in self.loops[0].subsystems]

    @property
    def object(self) -> str:
        """The copied quantity of the driven peer, "" if none."""
        local = self.copies[self.local]
        return local[0] if local else ""

    @property
    def frame(self) -> float:
        """The length of a frame, in s."""
        return float(self.loops[0].frame)

    @property
    def parts(self) -> list[tuple[int, int, float]]:
        """The modes of the driven peer: the loop, the subsystem, and the share of the force on the peer."""
        n = self.members[self.local]
        common = (0, self.local, 1 / n)
        return [common] if self.unpaired is None else [common, (self.unpaired, 0, 1 - 1 / n)]

    @functools.cached_property
    def bases(self) -> tuple[Floats, ...]:
        """The rigid modes of each loop."""
        return tuple(find_rigid_modes(loop).basis for loop in self.plain)

    @functools.cached_property
    def drifting(self) -> bool:
        """Whether the model has rigid modes."""
        return any(basis.size for basis in self.bases)

    def steady(self, s: Complex, aliases: Sequence[int]) -> list[Carried]:
        """Return the responses on the imaginary axis, also at multiples of the frame rate.

        Notes
        -----
        There e^{sT} = 1, and the equations of a frame of a model with rigid modes are singular, although the
        response has a value: the mean over a circle about s. The mean of the values times the direction is 0
        if no pole is inside.
        """
        rotations = s.imag * self.frame / (2 * np.pi)
        near = (np.abs(rotations - np.round(rotations)) < NEAR) & (rotations > 0.5)
        near = near & self.drifting if near.any() else near
        pairs = [(np.zeros(len(s), np.complex128), np.zeros(len(s))) for _ in range(len(aliases) + 2)]
        if not near.all():
            for (value, error_bound), (local, uncertainty) in zip(
                pairs, self.at(s[~near], aliases), strict=True
            ):
                value[~near], error_bound[~near] = local, uncertainty
        around = ASIDE * np.exp(2j * np.pi * (np.arange(AROUND) + 0.5) / AROUND)
        for index in np.flatnonzero(near):
            circles = self.at(s[index] + np.concatenate([2 * around, around]), aliases)
            for (value, error_bound), (local, uncertainty) in zip(pairs, circles, strict=True):
                inner = local[AROUND:]
                pole = abs((inner * around).mean()) / ASIDE
                value[index] = inner.mean()
                error_bound[index] = abs(local[:AROUND].mean() - value[index]) + pole + uncertainty.max()
        return pairs

    def at(
        self, s: Complex, aliases: Sequence[int] = (0,), *, difference_loops: bool = True
    ) -> list[Carried]:
        """Return the velocity here at each alias, the velocity there, and the copy's error (k,).

        The last is 0 unless `difference_loops` requests the distance of copies.
        """
        requested = [(self.velocity, alias) for alias in aliases]
        requested += [(self.arriving, 0), (self.error if difference_loops else ({}, {}), 0)]
        matrices: list[Matrix] = [np.zeros((len(s), 2, 1, 1), np.complex128) for _ in requested]
        for part, (number, subsystem, share) in enumerate(self.parts):
            rows = [
                (of, (*index, alias), weight)
                for of, (weights, alias) in enumerate(requested)
                for index, weight in weights[part].items()
            ]
            moved = spectra(self.loops[number], subsystem, [row for _, row, _ in rows], s)
            for (of, _, weight), matrix in zip(rows, moved, strict=True):
                by = np.array([[weight * share]])
                matrices[of] = MIDPOINT_RADIUS.add(
                    matrices[of],
                    MIDPOINT_RADIUS.multiply(matrix, with_error_radius(by, 8 * UNIT_ROUNDOFF * np.abs(by))),
                )
        return [(matrix[:, 0, 0, 0], matrix[:, 1, 0, 0].real) for matrix in matrices]

    @property
    def velocity(self) -> Weights:
        """The velocity of the driven device as a quantity."""
        return {(self.local, self.device.velocity): 1.0}, {(0, self.device.velocity): 1.0}

    @property
    def arriving(self) -> Weights:
        """The velocity of the other device as a quantity: the differences of peers of a class sum to 0."""
        share = 1.0 if self.same else 1 / (1 - self.members[self.local]) if self.local == self.to else 0.0
        difference_loops = {(0, self.other.velocity): share} if share else {}
        return {(self.to, self.other.velocity): 1.0}, difference_loops

    @property
    def error(self) -> Weights:
        """Distance of the driven peer's copy from the mean of all others of its name; None if alone"""
        pushed = self.copies[self.local]
        others = {
            (index, copy[1]): self.members[index] - (index == self.local)
            for index, copy in enumerate(self.copies)
            if pushed and copy and copy[0] == pushed[0]
        }
        total = sum(others.values())
        if pushed is None or not total:
            return {}, {}
        common = {index: (index[0] == self.local) - many / total for index, many in others.items()}
        return {index: weight for index, weight in common.items() if abs(weight) > UNIT_ROUNDOFF}, {
            (0, pushed[1]): 1 + 1 / total
        }


def _copy_of(group: PeerClass, device: Device) -> tuple[str, int] | None:
    """Return the copied quantity that a peer sends the position of, and its state; None if there is none.

    Of a position with several axes it is the one along the axis of the driven device.
    """
    _, axis = whole_and_index(device.part)
    peer_type = group.jacobians.peer_type
    for send, sending in zip(group.subsystem.sends, peer_type.sends, strict=True):
        for row, unit in zip(send.x, sending.units, strict=True):
            indices = np.flatnonzero(row)
            if unit == "m" and len(indices) == 1 and row[indices[0]] == 1:
                index = int(indices[0])
                if whole_and_index(peer_type.states[index].name)[1] == axis:
                    return peer_type.states[index].name.rpartition(".")[0], index
    return None
