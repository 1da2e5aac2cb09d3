"""The plan of an analysis: its method, and the systems to solve.

Takes: a `NumericModel`.
Gives: `AnalysisPlan`, `make_plan`; `refuse_varying`, `is_large_ring`, `not_populations`; `cannot_serve`.
Guarantees: nothing is solved, and no matrix of a complete system is built.
Does not: analyse (see `analysis`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from apc.analysis.methods import METHODS, PAPER
from apc.analysis.switches import varying_slopes
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.numeric_model import NumericModel
from apc.linearization.jacobians import SubsystemJacobians
from apc.spectrum.graph_loops import reason_without_common_graph
from apc.spectrum.interconnection import ModalSystem
from apc.spectrum.modes import decompose, dense_loop, refuse_dense
from apc.spectrum.peer_classes import (
    PeerClass,
    classes_of_peers,
    has_more_states,
    incomplete_links,
    too_large,
    used_coupling_terms,
)
from apc.support.memory import refuse_beyond
from apc.support.state_limits import MATRIX_STATES
from apc.timing.communication_graph import CommunicationGraph
from apc.timing.schedule import Schedule

# Up to this number of states of different peers, one matrix of all peers is faster than a determinant, and
# gives more results.
FEW_STATES = 200

# Equal peers on a ring form one system for each pair of the ring's eigenvalues: more systems take minutes.
LARGEST_RING = 2000

# From this number of packets in transit, a method without them in the state is faster.
LONG_LINES = 60

# A determinant has a row for each packet sent in a frame. Where packets take fewer frames than this, a matrix
# with all of them is smaller than the determinant's, and its eigenvalues are well conditioned.
MANY_FRAMES = 10


# Bytes for each entry of a system's matrix: of its stored results, and of the system that is being solved.
CACHE_SIZE, AT_WORK = 200, 500
# Bytes for each entry of a determinant's matrix, sent by received values: stored per subsystem, and while
# solving.
CACHE_SIZE_OF_SUBSYSTEM, SUBSYSTEM_AT_WORK = 200, 6000


@dataclass(frozen=True, slots=True)
class AnalysisPlan:
    """The method of an analysis, with the classes of equal peers and their loops.

    Classes and loops are empty for many different peers (see `FEW_STATES`). `systems` are the (count, size)
    of the systems to solve: states, or rows of a determinant.
    """

    method: str
    peer_classes: tuple[PeerClass, ...]
    loops: tuple[ModalSystem, ...]
    systems: tuple[tuple[int, int], ...]
    notes: tuple[str, ...]


def refuse_varying(model: Model, jacobians: Sequence[SubsystemJacobians]) -> None:
    """Raise an error if an equation's slopes vary with time: frozen at one instant they are another model.

    Parameters
    ----------
    model
        The compiled model.
    jacobians
        One for each peer type.

    Raises
    ------
    ApcError
        E810 an equation whose slopes vary with time.
    """
    for subsystem in jacobians:
        if names := varying_slopes(subsystem):
            message = f"the equation of {names[0]} multiplies a state by a function of time"
            why = "frames differ, so there is no verdict; use a simulation"
            location = SourceLocation(model.origin.topology)
            raise ApcError(Diagnostic("E810", location, f"{message}: {why}", fix="apc simulate"))


def make_plan(numeric: NumericModel, method: str = "auto") -> AnalysisPlan:
    """Return the plan with the fastest applicable method, or with the method that the caller names.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    method
        One of `methods.METHODS` except the paper's; "auto" selects the fastest.

    Raises
    ------
    ApcError
        E804 a system of too many states for its matrix, E850 a method that is not applicable; and the errors
        of `refuse_varying` and `peer_classes.classes_of_peers`.
    """
    model, comm_graph = numeric.model, numeric.comm_graph
    if method not in METHODS or method == PAPER:
        raise cannot_serve(model, method, f"available methods: {', '.join(METHODS)}")
    refuse_varying(model, numeric.jacobians)
    populations_allowed = method in ("auto", "determinant") and not not_populations(model, numeric.jacobians)
    if populations_allowed and (
        (method == "determinant" and _is_short_and_complete(numeric)) or has_more_states(numeric, FEW_STATES)
    ):
        sparse = incomplete_links(numeric.schedules, comm_graph)
        if not sparse:
            return _plan_populations(numeric)
        if method == "determinant":
            reason = f"the peers differ and are not completely connected over {sparse[0]}"
            raise cannot_serve(model, method, reason)
    peer_classes = classes_of_peers(numeric)
    if is_large_ring(peer_classes, comm_graph):
        message = (
            f"a ring of {comm_graph.peers:,} peers has as many subsystems; the limit is {LARGEST_RING:,}"
        )
        raise ApcError(
            Diagnostic("E804", SourceLocation(comm_graph.topology), message, fix=f"count: {LARGEST_RING}")
        )
    loops, chosen_method, notes = _loops_by_method(model, peer_classes, comm_graph, method)
    _refuse_large(comm_graph, loops, chosen_method, auto=method == "auto")
    return AnalysisPlan(chosen_method, peer_classes, loops, _sizes(loops, chosen_method), notes)


def _loops_by_method(
    model: Model, peer_classes: Sequence[PeerClass], comm_graph: CommunicationGraph, method: str
) -> tuple[tuple[ModalSystem, ...], str, tuple[str, ...]]:
    """Return the modal systems, the method, and the notes on its choice. Raises ApcError E850."""
    if method == "dense":
        refuse_dense(peer_classes, comm_graph)
        return (dense_loop(peer_classes, comm_graph),), "dense", ()
    decomposed = decompose(peer_classes, comm_graph)
    if method == "modes" and decomposed.method != "modes":
        raise cannot_serve(model, method, decomposed.notes[0])
    if method == "determinant":
        return decomposed.loops, method, decomposed.notes
    reason = _reason_for_determinant(decomposed.loops) if method == "auto" else ""
    if reason:
        return decomposed.loops, "determinant", (*decomposed.notes, reason)
    return decomposed.loops, decomposed.method, decomposed.notes


def _reason_for_determinant(loops: Sequence[ModalSystem]) -> str:
    """Return why the determinant is faster than matrices, "" if it is not."""
    packets = max(
        sum(sum(peer_class.schedule.depths) for peer_class in modal_system.peer_classes)
        for modal_system in loops
    )
    stored_outputs = max(
        sum(len(peer_class.schedule.discrete_states) for peer_class in modal_system.peer_classes)
        for modal_system in loops
    )
    many_packets = any(
        _long_lines(peer_class.schedule) for modal_system in loops for peer_class in modal_system.peer_classes
    )
    too_many_states = max(modal_system.states for modal_system in loops) > MATRIX_STATES
    if not many_packets and not (packets + stored_outputs > LONG_LINES and too_many_states):
        return ""
    in_flight = f"{packets:,} packets in transit are not states"
    return in_flight if packets > LONG_LINES else "a single matrix is too large"


def _refuse_large(
    comm_graph: CommunicationGraph, loops: Sequence[ModalSystem], method: str, *, auto: bool
) -> None:
    """Raise ApcError E804 for modal systems that are too large for a method, or for the memory."""
    largest = max(modal_system.states for modal_system in loops)
    if method == "determinant":
        needed_bytes = sum(_determinant_memory(modal_system) for modal_system in loops)
        subsystems = sum(len(modal_system.peer_classes) for modal_system in loops)
        message = f"{len(loops):,} determinants of {subsystems:,} different peers"
    else:
        if largest > MATRIX_STATES:
            first = next(modal_system.states for modal_system in loops if modal_system.states > MATRIX_STATES)
            raise too_large(comm_graph, f"{comm_graph.peers:,} peers", first, auto=auto)
        needed_bytes = CACHE_SIZE * sum(modal_system.states**2 for modal_system in loops)
        needed_bytes += AT_WORK * largest**2
        message = f"{len(loops):,} systems of up to {largest:,} states"
    advice = "reduce the number of different peers or of states"
    refuse_beyond(needed_bytes, "E804", SourceLocation(comm_graph.topology), message, advice)


def _long_lines(schedule: Schedule) -> bool:
    """Return whether many packets are in transit: above LONG_LINES, and above MANY_FRAMES frames of sent
    packets.
    """
    packets = sum(schedule.depths)
    return packets > max(LONG_LINES, MANY_FRAMES * len(schedule.sent))


def is_large_ring(peer_classes: Sequence[PeerClass], comm_graph: CommunicationGraph) -> bool:
    """Return whether all peers are equal and form one ring of more than LARGEST_RING peers."""
    coupling_terms = used_coupling_terms(peer_class.schedule for peer_class in peer_classes)
    shapes = {comm_graph.links[coupling_term.link].graph.shape for coupling_term in coupling_terms}
    if len(peer_classes) > 1 or shapes != {"ring"} or comm_graph.peers <= LARGEST_RING:
        return False
    return not reason_without_common_graph(coupling_terms, comm_graph)


def cannot_serve(model: Model, method: str, reason: str) -> ApcError:
    """Return the error E850 for a method that is not applicable, with its reason."""
    message = f"method {method} does not apply to this topology: {reason}"
    return ApcError(Diagnostic("E850", SourceLocation(model.origin.topology), message, fix="--method auto"))


def _sizes(loops: Sequence[ModalSystem], method: str) -> tuple[tuple[int, int], ...]:
    """Return (count, size) of the loops: the size is in states, or in rows of the determinant."""
    sizes = Counter(
        sum(len(peer_class.schedule.sent) for peer_class in modal_system.peer_classes)
        if method == "determinant"
        else modal_system.states
        for modal_system in loops
    )
    return tuple((count, size) for size, count in sizes.items())


def _determinant_memory(modal_system: ModalSystem) -> int:
    """Return the memory in bytes of a loop's determinant, given by its numbers of sent and received
    values.
    """
    entries = sum(len(peer_class.schedule.sent) for peer_class in modal_system.peer_classes) * sum(
        len(peer_class.schedule.received) for peer_class in modal_system.peer_classes
    )
    return (CACHE_SIZE_OF_SUBSYSTEM * len(modal_system.peer_classes) + SUBSYSTEM_AT_WORK) * entries


def not_populations(model: Model, jacobians: Sequence[SubsystemJacobians]) -> str:
    """Return the reason why the method for many different peers is not applicable, "" if it is applicable."""
    for peer_type, subsystem in zip(model.peer_types, jacobians, strict=True):
        if subsystem.edges:
            return f"{peer_type.name} depends on individual senders"
        if not subsystem.affine:
            return f"{peer_type.name} is not linear, so each peer is linearized at its own initial state"
    return ""


def _is_short_and_complete(numeric: NumericModel) -> bool:
    """Return whether peers differ, all graphs are complete, and at most LONG_LINES packets are in transit."""
    complete = not incomplete_links(numeric.schedules, numeric.comm_graph)
    short = max(sum(schedule.depths) for schedule in numeric.schedules) <= LONG_LINES
    return complete and short and sum(map(len, numeric.numbers.parameters)) > 1


def _plan_populations(numeric: NumericModel) -> AnalysisPlan:
    """Return the plan for many different peers on complete graphs: one determinant of all sent values."""
    rows = {
        (numeric.comm_graph.delay_class(index), sent)
        for index, schedule in enumerate(numeric.schedules)
        for sent in schedule.sent
    }
    note = "different peers: one determinant of the packets sent in a frame"
    return AnalysisPlan("determinant", (), (), ((1, len(rows)),), (note,))
