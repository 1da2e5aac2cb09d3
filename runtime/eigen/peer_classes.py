"""Classes of peers with equal motion: one subsystem each, linearized and lifted once.

Takes: an `Instance` of a model.
Gives: `PeerClass`, `peer_groups`, `representatives`, `more_differ`; `used_coupling_terms`, `states_of`;
`too_large`; `group_name`, `start_classes`.
Guarantees: there is one class for each distinct dynamics, found in a time proportional to the number of
peers; consecutive peers take no memory. A subsystem that is not affine is linearized at its own start values,
with receptions from the others at theirs. The matrices of a class exist in exact rationals as well, if its
functions can be evaluated operation by operation.
Does not: connect them (see `modes` and `interconnection`).
"""

from __future__ import annotations

import bisect
import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.communication_graph import CommunicationGraph
from apc.frame.evaluation_errors import at_part
from apc.frame.initial_reception import Gains, StartClasses
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.lift import FrameMap, check_packets, lift
from apc.frame.linear_subsystem import LinearSubsystem, rational_floats
from apc.frame.linearize import (
    InitialReception,
    linearize,
    linearize_exact,
    linearize_rows,
)
from apc.frame.numeric_model import Instance, PeerIndices
from apc.frame.schedule import CouplingTerm, Schedule

Floats = NDArray[np.float64]


# The limit of states in one system: at a cost of n³, its eigenvalues would take minutes, and their error
# bounds would decide nothing.
MOST_STATES = 1000

# The number of peers named in the name of a class that is part of a group.
MOST_NAMED = 4


@dataclass(frozen=True, slots=True, eq=False)
class PeerClass:
    """`count` peers with equal motion; `parameters` is the vector (n_p,) of the first of them.

    `peers` are their numbers in the model, from 0; `delay_class` is the model's group where it has delays of
    its own (see `CommunicationGraph.delay_class`); `index` is the class's key in `gains`. `exacting` gives
    `exact`, the subsystem's matrices in rationals, or its floats taken as exact where there are none, and
    `lifting` gives `lifted`: both are computed on first access.
    """

    name: str
    count: int
    parameters: Floats
    jacobians: SubsystemJacobians
    subsystem: LinearSubsystem
    exacting: Callable[[], LinearSubsystem]
    schedule: Schedule
    lifting: Callable[[], FrameMap]
    peers: PeerIndices
    delay_class: int
    index: int
    initial_reception: InitialReception | None
    gains: Gains

    @property
    def exact(self) -> LinearSubsystem:
        """The subsystem's matrices in rationals."""
        return self.exacting()

    @property
    def lifted(self) -> FrameMap:
        """The map of one frame, with its radii."""
        return self.lifting()

    @property
    def z_names(self) -> tuple[str, ...]:
        """The names of its states: continuous states, then discrete ones."""
        return (*(state.name for state in self.subsystem.peer_type.states), *self.schedule.value_names)

    def with_lifted(self, lifted: FrameMap) -> PeerClass:
        """Return the same peers with another map of one frame."""
        return replace(self, lifting=lambda: lifted)

    def sends(self, link: str) -> bool:
        """Return whether these peers send over a link."""
        return any(sending.link == link for sending in self.jacobians.peer_type.sends)

    def gain(self, coupling_term: CouplingTerm, sender: PeerClass) -> Fraction:
        """Return the factor of a sender's packets in a coupling term, in addition to the link's weights."""
        if not coupling_term.edge:
            return Fraction(1)
        listed = self.gains[coupling_term.edge, coupling_term.channel]
        return listed[0] if len(listed) == 1 else listed[sender.index]

    def with_subsystem(
        self,
        subsystem: LinearSubsystem,
        exact: LinearSubsystem,
        schedule: Schedule,
        lifted: FrameMap | None = None,
    ) -> PeerClass:
        """Return the same peers with other equations and events in a frame.

        Parameters
        ----------
        subsystem, exact
            The equations in floats and in rationals.
        schedule
            The events of a frame.
        lifted
            Their map over a frame; by default that of `lift`.
        """
        return replace(
            self,
            jacobians=replace(self.jacobians, peer_type=subsystem.peer_type),
            subsystem=subsystem,
            exacting=lambda: exact,
            schedule=schedule,
            lifting=functools.cache(lambda: lifted or lift(subsystem, schedule, exact=exact)),
        )


def build_group(
    instance: Instance,
    index: int,
    peers: PeerIndices,
    initial_reception: InitialReception | None = None,
    gains: Gains | None = None,
) -> PeerClass:
    """Return peers of equal motion as a class.

    Parameters
    ----------
    instance
        The model with its parameter values.
    index
        The key of the class in `gains`.
    peers
        Its peers; the first one represents all.
    initial_reception, gains
        Its receptions at the start and the gain for each sender, where they matter.
    """
    exchange = instance.exchange
    group, vector = exchange.group_of(peers.first), instance.vector(peers.first)
    built, schedule = instance.subsystems[group], instance.schedules[group]
    check_packets(schedule)
    subsystem = linearize(built, vector, initial_reception)

    @functools.cache
    def make_exact() -> LinearSubsystem:
        # The functions of a nonlinear loop cannot be evaluated operation by operation.
        return (
            linearize_exact(built, vector, initial_reception)
            if built.walkable
            else rational_floats(subsystem)
        )

    def make_lifted() -> FrameMap:
        return lift(subsystem, schedule, exact=make_exact() if built.walkable else None)

    return PeerClass(
        name=group_name(peers, exchange),
        count=len(peers),
        parameters=vector,
        jacobians=built,
        subsystem=subsystem,
        exacting=make_exact,
        schedule=schedule,
        lifting=functools.cache(make_lifted),
        peers=peers,
        delay_class=exchange.delay_class(group),
        index=index,
        initial_reception=initial_reception,
        gains=gains or {},
    )


def group_name(peers: PeerIndices, exchange: CommunicationGraph) -> str:
    """Return `left+right[1,3]`, for peers of the model's groups; all of a group are its name alone."""
    names, starts = [], exchange.starts.tolist()
    for end, listed in itertools.groupby(peers.runs, key=lambda run: bisect.bisect(starts, run.start)):
        inside, start = PeerIndices(tuple(listed)), starts[end - 1]
        name = exchange.groups[end - 1]
        if len(inside) < starts[end] - start:
            more = ["…"] if len(inside) > MOST_NAMED else []
            numbers = (str(peer - start + 1) for peer in itertools.islice(inside, MOST_NAMED))
            name += f"[{','.join([*numbers, *more])}]"
        names.append(name)
    if len(names) > MOST_NAMED:
        names = [*names[:MOST_NAMED], "…"]
    return "+".join(names)


def used_coupling_terms(schedules: Iterable[Schedule]) -> tuple[CouplingTerm, ...]:
    """Return every coupling term with a reception, in order."""
    return tuple(sorted({received.coupling_term for schedule in schedules for received in schedule.received}))


def states_of(schedule: Schedule, subsystem: SubsystemJacobians) -> int:
    """Return the number of states that a peer stores from frame to frame."""
    return len(subsystem.peer_type.states) + len(schedule.discrete_states) + sum(schedule.depths)


def check_size(subsystems: Sequence[SubsystemJacobians], exchange: CommunicationGraph) -> None:
    """Raise an error for more different peers than the limit."""
    states = sum(len(subsystem.peer_type.states) for subsystem in subsystems)
    if states > MOST_STATES:
        raise too_large(exchange, f"{len(subsystems):,} different peers", states)


# The subject of a refusal that a method without the matrix of all states avoids.
MATRIX = "the matrix of all states"


def too_large(exchange: CommunicationGraph, subject: str, states: int, *, auto: bool = False) -> ApcError:
    """Return the error for a system of too many states, by the method `auto` or an avoidable one."""
    spared = "" if auto else "; apc analyze --method auto needs no such matrix of linear ones"
    return ApcError(
        Diagnostic(
            "E804",
            SourceLocation(exchange.topology),
            f"{subject} make one system of {states:,} states; the matrix of one may have {MOST_STATES:,}",
            hint=f"fewer peers that differ{spared}",
            subject="" if auto else MATRIX,
        )
    )


# The limit of different peers whose pairs are evaluated: the slopes of edge functions and the receptions at
# the start cost their square.
MOST_DIFFERENT = 400


def peer_groups(instance: Instance) -> tuple[PeerClass, ...]:
    """Return the classes of equal peers of a model, each linearized once.

    Raises
    ------
    ApcError
        E801 a mean, maximum or minimum over no peers, E802 a mean whose weights add up to 0, E803 a maximum
        or minimum that is not smooth at the start, E804 more different peers than one system can contain,
        E808 a value that is not finite.
    """
    try:
        return _peer_groups(instance)
    except ApcError as error:
        origin = instance.system.origin
        raise ApcError(
            at_part(mistake, origin.topology, origin.texts) for mistake in error.mistakes
        ) from None


def _peer_groups(instance: Instance) -> tuple[PeerClass, ...]:
    """Return peers grouped by equal matrices; where the start matters, also by equal start."""
    exchange = instance.exchange
    by_matrices = all(subsystem.parameters_suffice for subsystem in instance.subsystems)
    classes = _classes(instance, by_matrices=True) if by_matrices else start_classes(instance)
    received: list[tuple[InitialReception | None, Gains]] = [(None, {})] * len(classes)
    indices = list(range(len(classes)))
    if not by_matrices:
        starting = StartClasses(instance, classes)
        listened = [starting.listen(g) for g in range(len(classes))]
        indices, classes = _merged(starting, listened, classes)
        received = [*listened]
    check_size([instance.subsystems[exchange.group_of(peers.first)] for peers in classes], exchange)
    return tuple(
        build_group(instance, index, peers, *received[index])
        for index, peers in zip(indices, classes, strict=True)
    )


def start_classes(instance: Instance) -> list[PeerIndices]:
    """Return the peers in classes of equal start values that receive from the same peers.

    Raises
    ------
    ApcError
        E804 more than MOST_DIFFERENT classes.
    """
    exchange = instance.exchange
    classes = _classes(instance, by_matrices=False)
    links = {coupling_term.link for coupling_term in used_coupling_terms(instance.schedules)}
    if not all(map(exchange.is_complete, links)):  # the senders may differ from peer to peer
        each = itertools.islice(itertools.chain.from_iterable(classes), MOST_DIFFERENT + 1)
        classes = [PeerIndices((range(peer, peer + 1),)) for peer in each]
    if len(classes) > MOST_DIFFERENT:
        message = f"more than {MOST_DIFFERENT} peers that differ, in their place in a graph or at the start,"
        raise ApcError(
            Diagnostic(
                "E804", SourceLocation(exchange.topology), f"{message} can't be linearized pair by pair"
            )
        )
    return sorted(classes, key=lambda peers: peers.first)


def _merged(
    starting: StartClasses, received: Sequence[tuple[InitialReception, Gains]], classes: Sequence[PeerIndices]
) -> tuple[list[int], list[PeerIndices]]:
    """Return the classes of equal start merged: the index of the first of each, and all its peers."""
    interchangeable = all(len(gain) == 1 for _, gains in received for gain in gains.values())
    members: dict[tuple[Any, ...], list[int]] = {}
    for g, (initial_reception, gains) in enumerate(received):
        same = (
            *(
                id(starting.subsystems[g]),
                starting.exchange.delay_class(starting.groups[g]),
                starting.vectors[g].tobytes(),
            ),
            *(initial_reception, tuple(gains.items()), g if not interchangeable else 0),
        )
        members.setdefault(same, []).append(g)
    return [listed[0] for listed in members.values()], [
        _joined(run for g in listed for run in classes[g].runs) for listed in members.values()
    ]


def _joined(runs: Iterable[range]) -> PeerIndices:
    """Return the peers of some runs, in order."""
    return PeerIndices(tuple(sorted(runs, key=lambda run: run.start)))


def _classes(instance: Instance, *, by_matrices: bool) -> list[PeerIndices]:
    """Return the peers of equal matrices, or of equal parameters, with the same peer type and role."""
    numbers, exchange = instance.numbers, instance.exchange
    classes: dict[tuple[int, int, bytes], list[range]] = {}
    for index, group in enumerate(instance.system.groups):
        vectors, start = numbers.parameters[index], int(exchange.starts[index])
        rows = linearize_rows(instance.subsystems[index], vectors) if by_matrices else vectors + 0.0
        keys = [(group.peer_type, exchange.delay_class(index), row.tobytes()) for row in rows]
        number = {key: count for count, key in enumerate(dict.fromkeys(keys))}
        if len(number) == 1:
            classes.setdefault(keys[0], []).append(range(start, start + group.count))
            continue
        of_peer = np.array([number[key] for key in keys])[numbers.rows[index]]
        ends = np.append(np.flatnonzero(np.diff(of_peer)) + 1, len(of_peer))
        listed = list(number)
        for first, end in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True):
            classes.setdefault(listed[of_peer[first]], []).append(range(start + first, start + end))
    return [PeerIndices(tuple(runs)) for runs in classes.values()]


def more_differ(instance: Instance, states: int) -> bool:
    """Return whether peers of different matrices, all affine and without edges, have too many states."""
    sizes = [len(subsystem.peer_type.states) for subsystem in instance.subsystems]
    different = map(len, instance.numbers.parameters)
    if sum(count * size for count, size in zip(different, sizes, strict=True)) <= states:
        return False
    # Peers that are all equal form a few systems of one peer's size, however large that is.
    return len(_classes(instance, by_matrices=True)) > max(1, states // max(sizes))


def representatives(instance: Instance) -> list[PeerClass]:
    """Return the first peer of each group, with the number of peers in the group."""
    runs = itertools.pairwise(instance.exchange.starts.tolist())
    return [build_group(instance, index, PeerIndices((range(*run),))) for index, run in enumerate(runs)]
