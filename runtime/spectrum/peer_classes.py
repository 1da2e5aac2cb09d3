"""Classes of peers with equal motion: one subsystem each, linearized and lifted once.

Takes: a `NumericModel`.
Gives: `PeerClass`, `classes_of_peers`, `representatives`, `has_more_states`; `used_coupling_terms`,
`incomplete_links`, `states_of`; `too_large`; `group_name`, `start_classes`.
Guarantees: there is one class for each distinct dynamics, found in a time proportional to the number of
peers; consecutive peers take no memory. A subsystem that is not affine is linearized at its own start values,
with receptions from the others at theirs. The matrices of a class exist in exact rationals as well, if its
functions can be evaluated operation by operation.
Does not: connect them (see `modes` and `interconnection`).
"""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.initial_reception import Gains, StartClasses
from apc.lifting.lift import FrameMap, check_packets, lift
from apc.lifting.model_numbers import PeerIndices, cached_in_model
from apc.lifting.numeric_model import NumericModel
from apc.linearization.evaluation_errors import at_part
from apc.linearization.jacobians import SubsystemJacobians
from apc.linearization.linear_subsystem import LinearSubsystem, every_matrix, rational_floats
from apc.linearization.linearize import (
    InitialReception,
    linearize,
    linearize_exact,
    linearize_rows,
)
from apc.support.state_limits import MATRIX_STATES
from apc.timing.communication_graph import CommunicationGraph
from apc.timing.schedule import CouplingTerm, Schedule

Floats = NDArray[np.float64]


# The number of peers named in the name of a class that is part of a group.
MOST_NAMED = 4


@dataclass(frozen=True, slots=True, eq=False)
class PeerClass:
    """`count` peers with equal motion; `parameters` is the vector (n_p,) of the first of them, also as
    exact rationals.

    `peers` are the numbers of these peers in the model, from 0; `delay_class` is the model's group where it
    has delays of its own (see `CommunicationGraph.delay_class`); `index` identifies the class in its model,
    and is its key in `gains`. `exact` are the subsystem's matrices in rationals, or its floats taken as exact
    where there are none. `frame_map` is None for a class that is only examined for rigid modes.
    """

    name: str
    count: int
    parameters: Floats
    exact_parameters: tuple[Fraction, ...]
    jacobians: SubsystemJacobians
    subsystem: LinearSubsystem
    exact: LinearSubsystem
    schedule: Schedule
    frame_map: FrameMap | None
    peers: PeerIndices
    delay_class: int
    index: int
    initial_reception: InitialReception | None
    gains: Gains

    @property
    def lifted(self) -> FrameMap:
        """The map of one frame, with its radii."""
        assert self.frame_map is not None, f"{self.name} was not lifted"
        return self.frame_map

    @property
    def z_names(self) -> tuple[str, ...]:
        """The names of the states of z: continuous states, then discrete states."""
        return (*(state.name for state in self.subsystem.peer_type.states), *self.schedule.value_names)

    def with_lifted(self, lifted: FrameMap) -> PeerClass:
        """Return the same class of peers with another frame map."""
        return replace(self, frame_map=lifted)

    def sends(self, link: str) -> bool:
        """Return whether these peers send over a link."""
        return any(sending.link == link for sending in self.jacobians.peer_type.sends)

    def gain(self, coupling_term: CouplingTerm, sender: PeerClass) -> Fraction:
        """Return the factor of a sender's packets in a coupling term, in addition to the link's weights."""
        if not coupling_term.edge:
            return Fraction(1)
        gains = self.gains[coupling_term.edge, coupling_term.channel]
        return gains[0] if len(gains) == 1 else gains[sender.index]

    def exact_at(self, vector: Floats) -> list[Fraction]:
        """Return other parameters (n_p,) exactly; those with present values are the present ones."""
        present = zip(self.parameters.tolist(), self.exact_parameters, vector.tolist(), strict=True)
        return [exact if value == number else Fraction(value) for number, exact, value in present]

    def with_subsystem(
        self,
        subsystem: LinearSubsystem,
        exact: LinearSubsystem,
        schedule: Schedule,
        lifted: FrameMap | None = None,
    ) -> PeerClass:
        """Return the same class of peers with other equations and another schedule.

        Parameters
        ----------
        subsystem, exact
            The equations in floats and in rationals.
        schedule
            The events of a frame.
        lifted
            The frame map of the equations; by default that of `lift`.
        """
        return replace(
            self,
            jacobians=replace(self.jacobians, peer_type=subsystem.peer_type),
            subsystem=subsystem,
            exact=exact,
            schedule=schedule,
            frame_map=lifted or lift(subsystem, schedule, exact=exact),
        )


def build_class(
    numeric: NumericModel,
    index: int,
    peers: PeerIndices,
    initial_reception: InitialReception | None = None,
    gains: Gains | None = None,
    *,
    lifted: bool = True,
) -> PeerClass:
    """Return peers of equal motion as a class, linearized with the parameters of the first peer, and lifted.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    index
        The index of the class.
    peers
        The peers of the class; the first one represents all.
    initial_reception, gains
        The values received at the start, and the gain for each sender; None for affine equations.
    lifted
        Whether the class is lifted.
    """
    comm_graph = numeric.comm_graph
    group, vector = comm_graph.group_of(peers.first), numeric.vector(peers.first)
    jacobians, schedule = numeric.subsystems[group], numeric.schedules[group]
    check_packets(schedule)
    exact_vector, exact = numeric.exact_vector(peers.first), None
    if jacobians.walkable:  # the functions of a nonlinear loop cannot be evaluated operation by operation
        exact = linearize_exact(jacobians, exact_vector, initial_reception)
    if exact is not None and jacobians.edges:
        # A sum of slopes over many peers: rounded once, whatever the cancellation.
        subsystem = every_matrix(exact, lambda matrix: matrix.astype(np.float64))
    else:
        subsystem = linearize(jacobians, vector, initial_reception)
    return PeerClass(
        name=group_name(peers, comm_graph),
        count=len(peers),
        parameters=vector,
        exact_parameters=tuple(exact_vector),
        jacobians=jacobians,
        subsystem=subsystem,
        exact=rational_floats(subsystem) if exact is None else exact,
        schedule=schedule,
        frame_map=lift(subsystem, schedule, exact=exact) if lifted else None,
        peers=peers,
        delay_class=comm_graph.delay_class(group),
        index=index,
        initial_reception=initial_reception,
        gains=gains or {},
    )


def group_name(peers: PeerIndices, comm_graph: CommunicationGraph) -> str:
    """Return the name of some peers, such as `left+right[1,3]`.

    All peers of a group are named by the group alone.
    """
    names, starts = [], comm_graph.starts.tolist()
    for group_number, runs in itertools.groupby(peers.runs, key=lambda run: bisect.bisect(starts, run.start)):
        peers_of_group, start = PeerIndices(tuple(runs)), starts[group_number - 1]
        name = comm_graph.groups[group_number - 1]
        if len(peers_of_group) < starts[group_number] - start:
            more = ["…"] if len(peers_of_group) > MOST_NAMED else []
            numbers = (str(peer - start + 1) for peer in itertools.islice(peers_of_group, MOST_NAMED))
            name += f"[{','.join([*numbers, *more])}]"
        names.append(name)
    if len(names) > MOST_NAMED:
        names = [*names[:MOST_NAMED], "…"]
    return "+".join(names)


def used_coupling_terms(schedules: Iterable[Schedule]) -> tuple[CouplingTerm, ...]:
    """Return every coupling term with a reception, sorted."""
    return tuple(sorted({received.coupling_term for schedule in schedules for received in schedule.received}))


def incomplete_links(schedules: Iterable[Schedule], comm_graph: CommunicationGraph) -> list[str]:
    """Return the links with a reception whose graph is not complete, without repetition."""
    links = dict.fromkeys(coupling_term.link for coupling_term in used_coupling_terms(schedules))
    return [link for link in links if not comm_graph.is_complete(link)]


def states_of(schedule: Schedule, subsystem: SubsystemJacobians) -> int:
    """Return the number of states that a peer stores from frame to frame."""
    return len(subsystem.peer_type.states) + len(schedule.discrete_states) + sum(schedule.depths)


def check_size(subsystems: Sequence[SubsystemJacobians], comm_graph: CommunicationGraph) -> None:
    """Raise ApcError E804 for different peers with too many states."""
    states = sum(len(subsystem.peer_type.states) for subsystem in subsystems)
    if states > MATRIX_STATES:
        raise too_large(comm_graph, f"{len(subsystems):,} different peers", states)


# The subject of a refusal that a method without the matrix of all states avoids.
MATRIX = "the matrix of all states"


def too_large(comm_graph: CommunicationGraph, subject: str, states: int, *, auto: bool = False) -> ApcError:
    """Return the error E804 for a system of too many states.

    Parameters
    ----------
    comm_graph
        The communication graph.
    subject, states
        The peers of the system in words, and its number of states.
    auto
        Whether the method was chosen automatically.
    """
    spared = "" if auto else "; apc analyze --method auto needs no such matrix for linear topologies"
    return ApcError(
        Diagnostic(
            "E804",
            SourceLocation(comm_graph.topology),
            f"{subject} form one system of {states:,} states; the limit is {MATRIX_STATES:,}",
            advice=f"reduce the number of different peers{spared}",
            subject="" if auto else MATRIX,
        )
    )


# The limit of different peers whose pairs are evaluated: the slopes of edge functions and the receptions at
# the start cost their square.
MOST_DIFFERENT = 400


@cached_in_model
def classes_of_peers(numeric: NumericModel) -> tuple[PeerClass, ...]:
    """Return the classes of equal peers of a model, each linearized once.

    Raises
    ------
    ApcError
        E801 a mean, maximum or minimum over no peers, E802 a mean whose weights add up to 0, E803 a maximum
        or minimum that is not smooth at the start, E804 more different peers than one system can contain,
        E808 a value that is not finite.
    """
    try:
        return _classes_of_peers(numeric)
    except ApcError as error:
        origin = numeric.model.origin
        raise ApcError(
            at_part(mistake, origin.topology, origin.texts) for mistake in error.mistakes
        ) from None


def _classes_of_peers(numeric: NumericModel) -> tuple[PeerClass, ...]:
    """Return peers in classes of equal matrices; if the start affects the matrices, also of equal start."""
    comm_graph = numeric.comm_graph
    by_matrices = all(subsystem.parameters_suffice for subsystem in numeric.subsystems)
    classes = _classes(numeric, by_matrices=True) if by_matrices else start_classes(numeric)
    received: list[tuple[InitialReception | None, Gains]] = [(None, {})] * len(classes)
    indices = list(range(len(classes)))
    if not by_matrices:
        start = StartClasses(numeric, classes)
        receptions = [start.reception(g) for g in range(len(classes))]
        indices, classes = _merged_classes(start, receptions, classes)
        received = [*receptions]
    check_size([numeric.subsystems[comm_graph.group_of(peers.first)] for peers in classes], comm_graph)
    return tuple(
        build_class(numeric, index, peers, *received[index])
        for index, peers in zip(indices, classes, strict=True)
    )


def start_classes(numeric: NumericModel) -> list[PeerIndices]:
    """Return the peers in classes of equal start values that receive from the same peers.

    Raises
    ------
    ApcError
        E804 more than MOST_DIFFERENT classes.
    """
    comm_graph = numeric.comm_graph
    classes = _classes(numeric, by_matrices=False)
    if incomplete_links(numeric.schedules, comm_graph):  # the senders may differ from peer to peer
        first_peers = itertools.islice(itertools.chain.from_iterable(classes), MOST_DIFFERENT + 1)
        classes = [PeerIndices((range(peer, peer + 1),)) for peer in first_peers]
    if len(classes) > MOST_DIFFERENT:
        message = f"more than {MOST_DIFFERENT} peers with different connections or initial states"
        raise ApcError(
            Diagnostic("E804", SourceLocation(comm_graph.topology), f"{message} can't be linearized")
        )
    return sorted(classes, key=lambda peers: peers.first)


def _merged_classes(
    start: StartClasses, received: Sequence[tuple[InitialReception, Gains]], classes: Sequence[PeerIndices]
) -> tuple[list[int], list[PeerIndices]]:
    """Return classes of equal start merged by their receptions.

    Parameters
    ----------
    start, classes
        The start of the classes, and the peers of each.
    received
        The reception of each class at the start, and the gains of its edge functions.

    Returns
    -------
    list of int
        The index of the first class of each merged class.
    list of PeerIndices
        The peers of each merged class.
    """
    interchangeable = all(len(gain) == 1 for _, gains in received for gain in gains.values())
    members: dict[tuple[Any, ...], list[int]] = {}
    for g, (initial_reception, gains) in enumerate(received):
        key = (
            *(
                start.peer_types[g],
                start.comm_graph.delay_class(start.groups[g]),
                start.vectors[g].tobytes(),
            ),
            *(initial_reception, tuple(gains.items()), g if not interchangeable else 0),
        )
        members.setdefault(key, []).append(g)
    return [merged[0] for merged in members.values()], [
        _sorted_runs(run for g in merged for run in classes[g].runs) for merged in members.values()
    ]


def _sorted_runs(runs: Iterable[range]) -> PeerIndices:
    """Return the peers of some runs, sorted."""
    return PeerIndices(tuple(sorted(runs, key=lambda run: run.start)))


def _classes(numeric: NumericModel, *, by_matrices: bool) -> list[PeerIndices]:
    """Return the peers in classes of equal matrices, or of equal parameters, with the same peer type and
    delays.
    """
    numbers, comm_graph = numeric.numbers, numeric.comm_graph
    classes: dict[tuple[int, int, bytes], list[range]] = {}
    for index, group in enumerate(numeric.model.groups):
        vectors, start = numbers.parameters[index], int(comm_graph.starts[index])
        rows = linearize_rows(numeric.subsystems[index], vectors) if by_matrices else vectors + 0.0
        keys = [(group.peer_type, comm_graph.delay_class(index), row.tobytes()) for row in rows]
        key_numbers = {key: count for count, key in enumerate(dict.fromkeys(keys))}
        if len(key_numbers) == 1:
            classes.setdefault(keys[0], []).append(range(start, start + group.count))
            continue
        key_of_peer = np.array([key_numbers[key] for key in keys])[numbers.rows[index]]
        ends = np.append(np.flatnonzero(np.diff(key_of_peer)) + 1, len(key_of_peer))
        distinct_keys = list(key_numbers)
        for first, end in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True):
            classes.setdefault(distinct_keys[key_of_peer[first]], []).append(
                range(start + first, start + end)
            )
    return [PeerIndices(tuple(runs)) for runs in classes.values()]


def has_more_states(numeric: NumericModel, states: int) -> bool:
    """Return whether the peers with different matrices have more than `states` states.

    All peers must be affine, without edge functions.
    """
    sizes = [len(subsystem.peer_type.states) for subsystem in numeric.subsystems]
    different = map(len, numeric.numbers.parameters)
    if sum(count * size for count, size in zip(different, sizes, strict=True)) <= states:
        return False
    # Peers that are all equal form a few systems of one peer's size, however large that is.
    return len(_classes(numeric, by_matrices=True)) > max(1, states // max(sizes))


@cached_in_model
def representatives(numeric: NumericModel) -> tuple[PeerClass, ...]:
    """Return a class for each group of the model, with the parameters of its first peer, not lifted."""
    runs = itertools.pairwise(numeric.comm_graph.starts.tolist())
    return tuple(
        build_class(numeric, index, PeerIndices((range(*run),)), lifted=False)
        for index, run in enumerate(runs)
    )
