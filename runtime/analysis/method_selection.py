"""The plan of an analysis: its method, and the systems to solve.

Takes: an `Instance` of a model.
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
from apc.eigen.graph_loops import common_graph
from apc.eigen.interconnection import ModalSystem
from apc.eigen.modes import decompose, dense_loop, refuse_dense
from apc.eigen.peer_classes import (
    MOST_STATES,
    PeerClass,
    more_differ,
    peer_groups,
    too_large,
    used_coupling_terms,
)
from apc.frame.communication_graph import CommunicationGraph
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.numeric_model import Instance
from apc.frame.schedule import Schedule
from apc.memory import refuse_beyond

# Up to this number of states of different peers, one matrix of all is faster than a method without it, and
# gives more results.
FEW_STATES = 200

# Equal peers on a ring are one system for each pair of its eigenvalues: more than these take minutes.
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
    """The method, and the groups of equal peers with their loops; neither for thousands of peers.

    `systems` are (number, size): states, or rows of a determinant.
    """

    method: str
    groups: tuple[PeerClass, ...]
    loops: tuple[ModalSystem, ...]
    systems: tuple[tuple[int, int], ...]
    notes: tuple[str, ...]


def refuse_varying(system: Model, jacobians: Sequence[SubsystemJacobians]) -> None:
    """Raise an error for equations whose slopes vary with time: frozen at an instant, they are another model.

    Parameters
    ----------
    system
        The compiled model.
    jacobians
        One for each peer type.

    Raises
    ------
    ApcError
        E810 such an equation.
    """
    for subsystem in jacobians:
        if names := varying_slopes(subsystem):
            message = f"the equation of {names[0]} multiplies what moves by what changes with time"
            why = "no one frame stands for all others, so that no verdict can be had; a simulation plays it"
            location = SourceLocation(system.origin.topology)
            raise ApcError(Diagnostic("E810", location, f"{message}: {why}", hint="apc simulate"))


def make_plan(instance: Instance, method: str = "auto") -> AnalysisPlan:
    """Return the plan with the method that suits a model, or with the requested one if it is applicable.

    Parameters
    ----------
    instance
        The model with its parameter values.
    method
        One of `methods.METHODS`, not the paper's.

    Raises
    ------
    ApcError
        E804 a system of too many states for its matrix, E850 a method that is not applicable; and those of
        `refuse_varying` and `peer_classes.peer_groups`.
    """
    system, exchange = instance.system, instance.exchange
    if method not in METHODS or method == PAPER:
        raise cannot_serve(system, method, f"the methods are {', '.join(METHODS)}")
    refuse_varying(system, instance.jacobians)
    can = method in ("auto", "determinant") and not not_populations(system, instance.jacobians)
    if can and ((method == "determinant" and _prompt(instance)) or more_differ(instance, FEW_STATES)):
        coupling_terms = used_coupling_terms(instance.schedules)
        sparse = [
            coupling_term.link
            for coupling_term in coupling_terms
            if not exchange.is_complete(coupling_term.link)
        ]
        if not sparse:
            return _plan_populations(instance)
        if method == "determinant":
            reason = f"the peers differ, and not all of them hear all others over {sparse[0]}"
            raise cannot_serve(system, method, reason)
    groups = peer_groups(instance)
    if is_large_ring(groups, exchange):
        message = f"a ring of {exchange.peers:,} peers is as many systems, up to {LARGEST_RING:,} are solved"
        raise ApcError(
            Diagnostic("E804", SourceLocation(exchange.topology), message, hint=f"count: {LARGEST_RING}")
        )
    if method == "dense":
        refuse_dense(groups, exchange)
        loops: tuple[ModalSystem, ...] = (dense_loop(groups, exchange),)
        text, notes = "dense", tuple[str, ...]()
    else:
        decomposed = decompose(groups, exchange)
        if method == "modes" and decomposed.method != "modes":
            raise cannot_serve(system, method, decomposed.notes[0])
        loops, text, notes = decomposed.loops, decomposed.method, decomposed.notes
        packets = max(sum(sum(group.schedule.depths) for group in loop.subsystems) for loop in loops)
        held = max(sum(len(group.schedule.discrete_states) for group in loop.subsystems) for loop in loops)
        if method == "determinant":
            text = method
        elif method == "auto" and (
            any(_long_lines(group.schedule) for loop in loops for group in loop.subsystems)
            or (packets + held > LONG_LINES and max(loop.states for loop in loops) > MOST_STATES)
        ):
            text = "determinant"
            in_flight = f"{packets:,} packets are on their way at a time, none of which is made a state"
            notes = (*notes, in_flight if packets > LONG_LINES else "one matrix of all is too large")
    if text != "determinant":
        for loop in loops:
            if loop.states > MOST_STATES:
                raise too_large(exchange, f"{exchange.peers:,} peers", loop.states, auto=method == "auto")
        needed = (
            CACHE_SIZE * sum(loop.states**2 for loop in loops)
            + AT_WORK * max(loop.states for loop in loops) ** 2
        )
        message = f"{len(loops):,} systems of up to {max(loop.states for loop in loops):,} states"
    else:
        needed = sum(_determinant_bytes(loop) for loop in loops)
        subsystems = sum(len(loop.subsystems) for loop in loops)
        message = f"{len(loops):,} determinants of {subsystems:,} peers that differ"
    refuse_beyond(
        needed, "E804", SourceLocation(exchange.topology), message, "fewer peers that differ, or fewer states"
    )
    return AnalysisPlan(text, groups, loops, _sizes(loops, text), notes)


def _long_lines(schedule: Schedule) -> bool:
    """Return whether many packets are in transit at a time, each for many frames."""
    packets = sum(schedule.depths)
    return packets > max(LONG_LINES, MANY_FRAMES * len(schedule.sent))


def is_large_ring(groups: Sequence[PeerClass], exchange: CommunicationGraph) -> bool:
    """Return whether all peers are equal, on one ring with too many eigenvalues for a system each."""
    coupling_terms = used_coupling_terms(group.schedule for group in groups)
    shapes = {exchange.links[coupling_term.link].graph.shape for coupling_term in coupling_terms}
    if len(groups) > 1 or shapes != {"ring"} or exchange.peers <= LARGEST_RING:
        return False
    return not common_graph(coupling_terms, exchange)


def cannot_serve(system: Model, method: str, reason: str) -> ApcError:
    """Return the error for a method that is not applicable."""
    message = f"method {method} can't serve this topology: {reason}"
    return ApcError(Diagnostic("E850", SourceLocation(system.origin.topology), message, hint="--method auto"))


def _sizes(loops: Sequence[ModalSystem], method: str) -> tuple[tuple[int, int], ...]:
    """Return the number of loops of each size."""
    sizes = Counter(
        sum(len(group.schedule.sent) for group in loop.subsystems) if method == "determinant" else loop.states
        for loop in loops
    )
    return tuple((count, size) for size, count in sizes.items())


def _determinant_bytes(loop: ModalSystem) -> int:
    """Return the memory of a loop's subsystems, each identified by its sent and received values."""
    entries = sum(len(subsystem.schedule.sent) for subsystem in loop.subsystems) * sum(
        len(subsystem.schedule.received) for subsystem in loop.subsystems
    )
    return (CACHE_SIZE_OF_SUBSYSTEM * len(loop.subsystems) + SUBSYSTEM_AT_WORK) * entries


def not_populations(system: Model, jacobians: Sequence[SubsystemJacobians]) -> str:
    """Return why the method for thousands of peers is not applicable, "" if it is."""
    for peer_type, subsystem in zip(system.peer_types, jacobians, strict=True):
        if subsystem.edges:
            return f"{peer_type.name} looks at each sender by itself"
        if not subsystem.affine:
            return f"{peer_type.name} is not linear, so that each peer is linearized where it starts"
    return ""


def _prompt(instance: Instance) -> bool:
    """Return whether peers differ, all graphs are complete, and few packets are in transit."""
    schedules = instance.schedules
    complete = all(
        instance.exchange.is_complete(coupling_term.link) for coupling_term in used_coupling_terms(schedules)
    )
    short = max(sum(schedule.depths) for schedule in schedules) <= LONG_LINES
    return complete and short and sum(map(len, instance.numbers.parameters)) > 1


def _plan_populations(instance: Instance) -> AnalysisPlan:
    """Return the plan for thousands of peers on complete graphs."""
    rows = {
        (instance.exchange.delay_class(index), sent)
        for index, schedule in enumerate(instance.schedules)
        for sent in schedule.sent
    }
    note = "peers of different numbers, by one determinant of what is sent in a frame"
    return AnalysisPlan("determinant", (), (), ((1, len(rows)),), (note,))
