"""Frequency responses of peers to a force on one device, composed of the responses of modes.

Takes: a `NumericModel` and two devices.
Gives: `Responses`, `responses`; `Weights`; `device_labels`.
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

from apc.analysis.analysis import lifted_classes
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.language.vectors import whole_and_index
from apc.haptics.device_port import DevicePort
from apc.haptics.modal_response import DrivenMode, driven_class_of, driven_mode, spectra
from apc.lifting.devices import LOCAL_MASS, Device, coupled_directly, find_device, find_devices
from apc.lifting.interval_arithmetic import MIDPOINT_RADIUS, UNIT_ROUNDOFF, with_error_radius
from apc.lifting.numeric_model import NumericModel
from apc.spectrum.interconnection import ModalSystem
from apc.spectrum.modes import accepted_loops
from apc.spectrum.peer_classes import PeerClass
from apc.spectrum.rigid_modes import find_rigid_modes
from apc.timing.communication_graph import CommunicationGraph

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
Matrix = NDArray[Any]

# Numbers (k,) with their error bounds.
Carried = tuple[Complex, Floats]

# The distance from an integer number of cycles per frame below which a model with rigid modes is evaluated on
# a circle around the frequency; the radius of the circle in 1/s, and its number of points.
NEAR, ASIDE, AROUND = 1e-5, 0.25, 16

# The limit of states and readings of all peer types together, in one matrix.
MOST_TOGETHER = 2000

# The limit of intervals times states of a peer: the forced increments and readings in a frame.
MOST_INCREMENTS = 4000


def responses(numeric: NumericModel, port: DevicePort, other: DevicePort) -> Responses:
    """Return the frequency responses of two devices to a force on the first.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    port, other
        The driven device and the other one.

    Raises
    ------
    ApcError
        E931 a peer without a device; E933 a model too large.
    """
    model = numeric.model
    peer_classes, comm_graph = lifted_classes(numeric)
    unit_of = {parameter.name: parameter.unit for parameter in model.parameters}
    direct = coupled_directly(model.peer_types)
    driven_classes, subsystems, gripped = [], {}, {}
    for peer_class in peer_classes:
        device = None
        for device_port in (other, port):
            if device_port.peer not in peer_class.peers:
                continue
            has_axis = port.peer in peer_class.peers or whole_and_index(port.part)[1]
            part_name = device_port.part or (port.part if has_axis else "")
            gripped[device_port] = device = _gripped_device(numeric, peer_class, part_name, unit_of)
        if device is None:
            result = find_device(
                peer_class.jacobians,
                peer_class.parameters,
                unit_of,
                peer_class.initial_reception,
                direct=direct,
            )
            device = result if isinstance(result, Device) else None
        _check_increments(model, peer_class)
        driven_class, subsystem = driven_class_of(peer_class, device)
        driven_classes.append(driven_class)
        subsystems[driven_class.index] = subsystem
    plain, driven_loops = (
        accepted_loops(classes, comm_graph, _are_by_class, "apc transparency")[0]
        for classes in (peer_classes, driven_classes)
    )
    common = driven_loops[0]
    if (states := sum(len(peer_class.z_names) for peer_class in common.peer_classes)) > MOST_TOGETHER:
        message = (
            f"{len(common.peer_classes):,} different peers have {states:,} states and samples in a frame"
        )
        advice = f"reduce the number of different peers (limit: {MOST_TOGETHER:,})"
        raise ApcError(
            Diagnostic(
                "E933", SourceLocation(model.origin.topology), f"apc transparency: {message}", advice=advice
            )
        )
    driven_index, other_index = (
        next(
            index
            for index, peer_class in enumerate(common.peer_classes)
            if device_port.peer in peer_class.peers
        )
        for device_port in (port, other)
    )
    name = common.peer_classes[driven_index].name
    difference_loops = [
        number
        for number, modal_system in enumerate(driven_loops)
        if number and modal_system.peer_classes[0].name == name
    ]
    return Responses(
        comm_graph=comm_graph,
        device=gripped[port],
        other=gripped[other],
        loops=tuple(driven_mode(modal_system, subsystems) for modal_system in driven_loops),
        plain=plain,
        members=tuple(peer_class.count for peer_class in common.peer_classes),
        local=driven_index,
        to=other_index,
        unpaired=difference_loops[0] if difference_loops else None,
        same=port.peer == other.peer,
    )


def _gripped_device(
    numeric: NumericModel, peer_class: PeerClass, part: str, unit_of: Mapping[str, str]
) -> Device:
    """Return the device of a class of peers, the only one if no part is named.

    Without a device, an error E931 is raised.
    """
    direct = coupled_directly(numeric.model.peer_types)
    device = find_device(
        peer_class.jacobians,
        peer_class.parameters,
        unit_of,
        peer_class.initial_reception,
        part=part,
        direct=direct,
    )
    if isinstance(device, Device):
        return device
    message = device or f"{peer_class.name} has no device"
    names = device_labels(numeric)
    local = [name for name in names if name.startswith(f"{peer_class.name}[")]
    fix = f'--at "{(local or names)[0]}"' if names else "" if device else LOCAL_MASS
    raise ApcError(Diagnostic("E931", SourceLocation(numeric.model.origin.topology), message, fix=fix))


def device_labels(numeric: NumericModel) -> list[str]:
    """Return the labels of all parts that can be a haptic device, for the first peer of each group.

    Such as `left[1].device`.
    """
    model = numeric.model
    unit_of, numbers = {parameter.name: parameter.unit for parameter in model.parameters}, numeric.numbers
    direct = coupled_directly(model.peer_types)
    return [
        f"{group.name}[1].{part}"
        for index, group in enumerate(model.groups)
        for part, result in find_devices(
            numeric.jacobians[group.peer_type], numbers.parameters[index][0], unit_of, direct=direct
        ).items()
        if isinstance(result, Device)
    ]


def _check_increments(model: Model, peer_class: PeerClass) -> None:
    """Raise ApcError E933 for a peer with too many events and states in a frame."""
    forced_increments = len(peer_class.schedule.events) * len(peer_class.subsystem.a)
    if forced_increments > MOST_INCREMENTS:
        message = f"a frame of {peer_class.name} has {forced_increments:,} events and states"
        advice = f"use at most {MOST_INCREMENTS:,} events and states"
        raise ApcError(Diagnostic("E933", SourceLocation(model.origin.topology), message, advice=advice))


def _are_by_class(loops: Sequence[ModalSystem]) -> bool:
    """Return whether loops are a common loop and a difference loop per class; a ring has other modes."""
    common, *difference_loops = loops
    many = {peer_class.name: peer_class.count - 1 for peer_class in common.peer_classes}
    return all(
        len(modal_system.peer_classes) == 1
        and modal_system.multiplicity == many.get(modal_system.peer_classes[0].name)
        for modal_system in difference_loops
    )


# The weights of an output over (subsystem, state): in the loop of class means, and in a peer's difference
# loop.
Weights = tuple[Mapping[tuple[int, int], float], Mapping[tuple[int, int], float]]


@dataclass(frozen=True, eq=False)
class Responses:
    """The frequency responses to a force on one peer's `device`: at this device, and at the `other` device.

    They are sums over the responses of modes: `loops` are the loop of all classes, then the difference loop
    of each class; `plain` are the same loops without inputs. A class is a subsystem of the first loop, and
    represents `members` peers; `local` is the index of the driven peer's class, `unpaired` the index of its
    difference loop, None for a single peer; `to` is the index of the other peer's class; `same` states
    whether both are one peer. `comm_graph` is the communication graph.
    """

    comm_graph: CommunicationGraph
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
        """For each class, the name of the object whose position it sends, and the index of that state."""
        return [_copy_of(subsystem.peer_class, self.device) for subsystem in self.loops[0].subsystems]

    @property
    def object(self) -> str:
        """The name of the driven peer's object copy, "" if it sends none."""
        local = self.copies[self.local]
        return local[0] if local else ""

    @property
    def frame(self) -> float:
        """The length of a frame in seconds."""
        return float(self.loops[0].frame)

    @property
    def parts(self) -> list[tuple[int, int, float]]:
        """The modes of the driven peer: index of the loop, index of the subsystem, share of the force in
        the mode.
        """
        n = self.members[self.local]
        common = (0, self.local, 1 / n)
        return [common] if self.unpaired is None else [common, (self.unpaired, 0, 1 - 1 / n)]

    @functools.cached_property
    def bases(self) -> tuple[Floats, ...]:
        """The bases of the rigid modes of each loop."""
        return tuple(find_rigid_modes(modal_system).basis for modal_system in self.plain)

    @functools.cached_property
    def drifting(self) -> bool:
        """Whether the model has rigid modes."""
        return any(basis.size for basis in self.bases)

    def steady(self, s: Complex, aliases: Sequence[int]) -> list[Carried]:
        """Return the responses (see `at`) on the imaginary axis, also at multiples of the frame rate.

        Notes
        -----
        At these e^{sT} = 1, and the equations of a frame of a model with rigid modes are singular, although
        the response is finite: it is the mean over a circle about s. The mean of the values times the
        direction is 0 if no pole is inside.
        """
        cycles = s.imag * self.frame / (2 * np.pi)
        near = (np.abs(cycles - np.round(cycles)) < NEAR) & (cycles > 0.5)
        near = near & self.drifting if near.any() else near
        results = [(np.zeros(len(s), np.complex128), np.zeros(len(s))) for _ in range(len(aliases) + 2)]
        if not near.all():
            for (value, error_bound), (values, bounds) in zip(
                results, self.at(s[~near], aliases), strict=True
            ):
                value[~near], error_bound[~near] = values, bounds
        offsets = ASIDE * np.exp(2j * np.pi * (np.arange(AROUND) + 0.5) / AROUND)
        for index in np.flatnonzero(near):
            circles = self.at(s[index] + np.concatenate([2 * offsets, offsets]), aliases)
            for (value, error_bound), (values, bounds) in zip(results, circles, strict=True):
                inner = values[AROUND:]
                pole = abs((inner * offsets).mean()) / ASIDE
                value[index] = inner.mean()
                error_bound[index] = abs(values[:AROUND].mean() - value[index]) + pole + bounds.max()
        return results

    def at(
        self, s: Complex, aliases: Sequence[int] = (0,), *, difference_loops: bool = True
    ) -> list[Carried]:
        """Return the velocity of the driven device at each alias, that of the other device, and the copy's
        error (k,).

        The copy's error is 0 unless `difference_loops` is True.
        """
        outputs = [(self.velocity, alias) for alias in aliases]
        outputs += [(self.arriving, 0), (self.error if difference_loops else ({}, {}), 0)]
        matrices: list[Matrix] = [np.zeros((len(s), 2, 1, 1), np.complex128) for _ in outputs]
        for part, (number, subsystem, share) in enumerate(self.parts):
            rows = [
                (output, (*index, alias), weight)
                for output, (weights, alias) in enumerate(outputs)
                for index, weight in weights[part].items()
            ]
            response = spectra(self.loops[number], subsystem, [row for _, row, _ in rows], s)
            for (output, _, weight), matrix in zip(rows, response, strict=True):
                factor = np.array([[weight * share]])
                matrices[output] = MIDPOINT_RADIUS.add(
                    matrices[output],
                    MIDPOINT_RADIUS.multiply(
                        matrix, with_error_radius(factor, 8 * UNIT_ROUNDOFF * np.abs(factor))
                    ),
                )
        return [(matrix[:, 0, 0, 0], matrix[:, 1, 0, 0].real) for matrix in matrices]

    @property
    def velocity(self) -> Weights:
        """The weights of the driven device's velocity."""
        return {(self.local, self.device.velocity): 1.0}, {(0, self.device.velocity): 1.0}

    @property
    def arriving(self) -> Weights:
        """The weights of the other device's velocity; the differences of the peers of a class sum to 0."""
        share = 1.0 if self.same else 1 / (1 - self.members[self.local]) if self.local == self.to else 0.0
        difference_loops = {(0, self.other.velocity): share} if share else {}
        return {(self.to, self.other.velocity): 1.0}, difference_loops

    @property
    def error(self) -> Weights:
        """The weights of the distance of the driven peer's copy from the mean of the others.

        The weights are empty without other copies.
        """
        driven_copy = self.copies[self.local]
        others = {
            (index, copy[1]): self.members[index] - (index == self.local)
            for index, copy in enumerate(self.copies)
            if driven_copy and copy and copy[0] == driven_copy[0]
        }
        total = sum(others.values())
        if driven_copy is None or not total:
            return {}, {}
        common = {index: (index[0] == self.local) - count / total for index, count in others.items()}
        return {index: weight for index, weight in common.items() if abs(weight) > UNIT_ROUNDOFF}, {
            (0, driven_copy[1]): 1 + 1 / total
        }


def _copy_of(peer_class: PeerClass, device: Device) -> tuple[str, int] | None:
    """Return the object copy whose position a peer sends, and the index of its state; None without a copy.

    If the position has several axes, the axis of the driven device is used.
    """
    _, axis = whole_and_index(device.part)
    peer_type = peer_class.jacobians.peer_type
    for send, sending in zip(peer_class.subsystem.sends, peer_type.sends, strict=True):
        for row, unit in zip(send.x, sending.units, strict=True):
            indices = np.flatnonzero(row)
            if unit == "m" and len(indices) == 1 and row[indices[0]] == 1:
                index = int(indices[0])
                if whole_and_index(peer_type.states[index].name)[1] == axis:
                    return peer_type.states[index].name.rpartition(".")[0], index
    return None
