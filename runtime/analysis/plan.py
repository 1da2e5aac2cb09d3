"""How a system is going to be analysed: by which method, as which systems.

Takes: an `Instance` of a scene.
Gives: `AnalysisPlan`, `make_plan`; `refuse_varying`, `is_large_ring`, `not_populations`.
Guarantees: nothing is solved, and no matrix of a whole system is built.
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
from apc.eigen.closing import ModalSystem
from apc.eigen.graph_loops import common_graph
from apc.eigen.modes import arrange, dense_loop, refuse_dense
from apc.eigen.peers import MOST_STATES, PeerClass, more_differ, peer_groups, too_large, used_ways
from apc.frame.exchange import CommunicationGraph
from apc.frame.instance import Instance
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.schedule import Schedule
from apc.memory import refuse_beyond

# Up to so many states of motion of peers that differ, one matrix of all is quicker than what spares it, and
# says more.
FEW_STATES = 200

# Equal peers on a ring are a system for each pair of its eigenvalues: more than these take minutes.
LARGEST_RING = 2000

# From so many packets on their way on, leaving them out of the state is quicker.
LONG_LINES = 60

# A determinant has a row for each packet sent in a frame. Where packets take fewer frames than this, a matrix
# with all of them is smaller than what the determinant takes, and its eigenvalues are well conditioned.
MANY_FRAMES = 10


# Bytes of an entry of a system's matrix: of each system what is told of it, of the one at work all it needs.
KEPT, AT_WORK = 200, 500
# Bytes of an entry of a determinant's matrix, of what all send by what all hear: of each site, and at work.
KEPT_OF_SITE, SITE_AT_WORK = 200, 6000


@dataclass(frozen=True, slots=True)
class AnalysisPlan:
    """The method, and the groups of equal peers with their loops; of peers by the thousand neither.

    `systems` are (how many, how large): states, or rows of a determinant.
    """

    method: str
    groups: tuple[PeerClass, ...]
    loops: tuple[ModalSystem, ...]
    systems: tuple[tuple[int, int], ...]
    notes: tuple[str, ...]


def refuse_varying(system: Model, jacobians: Sequence[SubsystemJacobians]) -> None:
    """Refuse equations whose slopes change with time: frozen at a moment, they'd answer for another scene.

    Parameters
    ----------
    system
        The compiled scene.
    jacobians
        One a kind.

    Raises
    ------
    ApcError
        E810 such an equation.
    """
    for site in jacobians:
        if names := varying_slopes(site):
            what = f"the equation of {names[0]} multiplies what moves by what changes with time"
            why = "no one frame stands for all others, so that no verdict can be had; a simulation plays it"
            place = SourceLocation(system.origin.topology)
            raise ApcError(Diagnostic("E810", place, f"{what}: {why}", hint="apc simulate"))


def make_plan(instance: Instance, method: str = "auto") -> AnalysisPlan:
    """Choose the method that serves a system, or see that one serves it that is asked for.

    Parameters
    ----------
    instance
        The scene with its numbers.
    method
        One of `methods.METHODS`, not the paper's.

    Raises
    ------
    ApcError
        E804 a system of too many states for its matrix, E850 a method that can't serve this scene; and those
        of `refuse_varying` and `peers.peer_groups`.
    """
    system, exchange = instance.system, instance.exchange
    if method not in METHODS or method == PAPER:
        raise cannot_serve(system, method, f"the methods are {', '.join(METHODS)}")
    refuse_varying(system, instance.jacobians)
    can = method in ("auto", "determinant") and not not_populations(system, instance.jacobians)
    if can and ((method == "determinant" and _prompt(instance)) or more_differ(instance, FEW_STATES)):
        ways = used_ways(instance.schedules)
        sparse = [way.link for way in ways if not exchange.is_complete(way.link)]
        if not sparse:
            return _plan_populations(instance)
        if method == "determinant":
            reason = f"the peers differ, and not all of them hear all others over {sparse[0]}"
            raise cannot_serve(system, method, reason)
    groups = peer_groups(instance)
    if is_large_ring(groups, exchange):
        what = f"a ring of {exchange.peers:,} peers is as many systems, up to {LARGEST_RING:,} are solved"
        raise ApcError(
            Diagnostic("E804", SourceLocation(exchange.scene), what, hint=f"count: {LARGEST_RING}")
        )
    if method == "dense":
        refuse_dense(groups, exchange)
        loops: tuple[ModalSystem, ...] = (dense_loop(groups, exchange),)
        text, notes = "dense", tuple[str, ...]()
    else:
        arranged = arrange(groups, exchange)
        if method == "modes" and arranged.method != "modes":
            raise cannot_serve(system, method, arranged.notes[0])
        loops, text, notes = arranged.loops, arranged.method, arranged.notes
        packets = max(sum(sum(group.schedule.depths) for group in loop.sites) for loop in loops)
        held = max(sum(len(group.schedule.carried) for group in loop.sites) for loop in loops)
        if method == "determinant":
            text = method
        elif method == "auto" and (
            any(_long_lines(group.schedule) for loop in loops for group in loop.sites)
            or (packets + held > LONG_LINES and max(loop.states for loop in loops) > MOST_STATES)
        ):
            text = "determinant"
            on_the_way = f"{packets:,} packets are on their way at a time, none of which is made a state"
            notes = (*notes, on_the_way if packets > LONG_LINES else "one matrix of all is too large")
    if text != "determinant":
        for loop in loops:
            if loop.states > MOST_STATES:
                raise too_large(exchange, f"{exchange.peers:,} peers", loop.states, auto=method == "auto")
        needed = (
            KEPT * sum(loop.states**2 for loop in loops) + AT_WORK * max(loop.states for loop in loops) ** 2
        )
        what = f"{len(loops):,} systems of up to {max(loop.states for loop in loops):,} states"
    else:
        needed = sum(_determinant_bytes(loop) for loop in loops)
        sites = sum(len(loop.sites) for loop in loops)
        what = f"{len(loops):,} determinants of {sites:,} peers that differ"
    refuse_beyond(
        needed, "E804", SourceLocation(exchange.scene), what, "fewer peers that differ, or fewer states"
    )
    return AnalysisPlan(text, groups, loops, _sizes(loops, text), notes)


def _long_lines(schedule: Schedule) -> bool:
    """Return whether many packets are in transit at a time, each for many frames."""
    packets = sum(schedule.depths)
    return packets > max(LONG_LINES, MANY_FRAMES * len(schedule.sent))


def is_large_ring(groups: Sequence[PeerClass], exchange: CommunicationGraph) -> bool:
    """Say whether all peers are equal, on one ring of too many for a system each."""
    ways = used_ways(group.schedule for group in groups)
    shapes = {exchange.links[way.link].graph.shape for way in ways}
    if len(groups) > 1 or shapes != {"ring"} or exchange.peers <= LARGEST_RING:
        return False
    return not common_graph(ways, exchange)


def cannot_serve(system: Model, method: str, reason: str) -> ApcError:
    """Return the refusal of a method that can't serve a scene."""
    what = f"method {method} can't serve this scene: {reason}"
    return ApcError(Diagnostic("E850", SourceLocation(system.origin.topology), what, hint="--method auto"))


def _sizes(loops: Sequence[ModalSystem], method: str) -> tuple[tuple[int, int], ...]:
    """Return how many loops there are of which size."""
    sizes = Counter(
        sum(len(group.schedule.sent) for group in loop.sites) if method == "determinant" else loop.states
        for loop in loops
    )
    return tuple((count, size) for size, count in sizes.items())


def _determinant_bytes(loop: ModalSystem) -> int:
    """Return what the sites of a loop take, each known by what all send and hear."""
    entries = sum(len(site.schedule.sent) for site in loop.sites) * sum(
        len(site.schedule.heard) for site in loop.sites
    )
    return (KEPT_OF_SITE * len(loop.sites) + SITE_AT_WORK) * entries


def not_populations(system: Model, jacobians: Sequence[SubsystemJacobians]) -> str:
    """Say why peers can't be taken by the thousand, "" if they can."""
    for kind, site in zip(system.kinds, jacobians, strict=True):
        if site.edges:
            return f"{kind.name} looks at each sender by itself"
        if not site.affine:
            return f"{kind.name} is not linear, so that each peer is linearized where it starts"
    return ""


def _prompt(instance: Instance) -> bool:
    """Say whether peers differ, all hear all others, and few packets are on their way."""
    schedules = instance.schedules
    complete = all(instance.exchange.is_complete(way.link) for way in used_ways(schedules))
    short = max(sum(schedule.depths) for schedule in schedules) <= LONG_LINES
    return complete and short and sum(map(len, instance.numbers.parameters)) > 1


def _plan_populations(instance: Instance) -> AnalysisPlan:
    """Plan for peers by the thousand that all hear all others."""
    rows = {
        (instance.exchange.role(place), sent)
        for place, schedule in enumerate(instance.schedules)
        for sent in schedule.sent
    }
    note = "peers of different numbers, by one determinant of what is sent in a frame"
    return AnalysisPlan("determinant", (), (), ((1, len(rows)),), (note,))
