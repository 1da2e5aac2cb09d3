"""A state space as a function of some of the scene's numbers.

Takes: a `Model`, names of its parameters. Gives: `state_space_of`.
Guarantees: what follows from a free number by a formula follows from it here too; at the scene's own numbers
the matrices are those of `lifted.state_space`, but for rounding.
Does not: free a time: another delay is another order of events, another number of states.

Where a free number moves a peer between the ticks (its mass, say), e^{Aτ} is squared from its Taylor series,
as often as makes the scene's own Aτ small: for numbers up to `SPAN` times as large nothing is lost.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import prepare_at_start
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.plain import symbolic
from apc.eigen.peers import PeerClass
from apc.exports.identifiers import ExportedSignal, words
from apc.exports.lifted import FrameNumbers, StateSpace, lifted, peers_of, state_space, steps_in_floats
from apc.frame.devices import ForceInput
from apc.frame.exchange import CommunicationGraph
from apc.frame.instance import PeerIndices, prepare
from apc.frame.linearize import site_of_entries
from apc.frame.names import ParameterRef, find, overlap, times_of, unit_of
from apc.frame.parameters import free_values
from apc.frame.radius import Arithmetic
from apc.frame.site import LinearSubsystem
from apc.network.nominal import refuse_channel_number

Matrix = NDArray[Any]

OPTION = "--free"

# How many times as large Aτ may be as in the scene before the series ends too soon, and its terms: of
# ‖Aτ‖ ≤ 1 the rest is less than 1/17!, 3e-15.
SPAN, TERMS = 64, 16


def state_space_of(system: Model, *, cut: str = "", free: Sequence[str] = ()) -> StateSpace:
    """Lift a scene, with its matrices as a function of some numbers.

    Parameters
    ----------
    system, cut
        As for `lifted.state_space`.
    free
        Parameters of the scene or of a group; none gives the matrices alone.

    Raises
    ------
    ApcError
        E622 no such parameter; E954 a time, or a scene whose start decides its slopes; and those of
        `lifted.state_space`.
    """
    space = state_space(system, cut=cut)
    if not free:
        return space
    frees = _frees(system, free)
    ports = tuple(ExportedSignal(free.label, unit_of(system, free.name)) for free in frees)
    symbols = [casadi.SX.sym(word) for word in words(ports)]
    prepared = prepare_at_start(system, prepare(system), frees)
    if prepared is None:
        what = "where the scene is linearized does not follow from its numbers alone"
        raise ApcError(Diagnostic("E954", SourceLocation(OPTION), what, hint=f"no {OPTION}"))
    groups, exchange = peers_of(system, prepared=prepared)
    groups = tuple(part for group in groups for part in _by_groups(group, exchange))
    values = dict(zip(frees, symbols, strict=True))

    def vector(group: PeerClass) -> Any:
        place = exchange.group_of(group.peers.first)
        peer = group.peers.first - int(exchange.starts[place])
        listed = free_values(system, system.groups[place], peer, values, symbolic)
        return casadi.vertcat(*map(casadi.SX, listed))

    blocks, _, _ = lifted(system, groups, exchange, cut, _numbers(vector))
    function = casadi.Function(
        "state_space", symbols, [*map(_matrix, blocks)], words(ports), ["A", "B", "C", "D"]
    )
    return replace(space, free=ports, function=function)


def _frees(system: Model, names: Sequence[str]) -> list[ParameterRef]:
    """Return what is free. Raises ApcError for what can't be."""
    frees: list[ParameterRef] = []
    for name in names:
        free = find(system, name, SourceLocation(OPTION))
        if times_of(system, free.name):
            what = f"{free.label} is a time: another one is another order of events, and another state"
            hint = f'one value at a time: --set {free.label}="…"'
            raise ApcError(Diagnostic("E954", SourceLocation(OPTION), what, hint=hint))
        refuse_channel_number(system, free, SourceLocation(OPTION))
        if any(overlap(system, free, other) for other in frees):
            what = f"{free.label} is named twice"
            raise ApcError(Diagnostic("E954", SourceLocation(OPTION), what, hint=f"{OPTION} {free.label}"))
        frees.append(free)
    return frees


def _by_groups(group: PeerClass, exchange: CommunicationGraph) -> list[PeerClass]:
    """Return equal peers apart by the scene's groups: a group's own number may be free."""
    runs = itertools.groupby(group.peers.runs, key=lambda run: exchange.group_of(run.start))
    parts = [PeerIndices(tuple(inside)) for _, inside in runs]
    return [replace(group, peers=peers, count=len(peers)) for peers in parts]


def _numbers(vector: Callable[[PeerClass], Any]) -> FrameNumbers:
    """Return what a frame is made of in CasADi's expressions of each group's vector (n_p,) of parameters."""

    def values(function: Any, group: PeerClass) -> list[Any]:
        rest = [casadi.DM.zeros(*function.size_in(place)) for place in range(function.n_in() - 2)]
        return [_plain(nonzero) for nonzero in function(*rest, vector(group), 0).nonzeros()]

    def site(group: PeerClass) -> LinearSubsystem:
        return site_of_entries(group.jacobians, values(group.jacobians.function, group), 0)

    def inverses(group: PeerClass, push: ForceInput) -> list[Any]:
        return values(push.symbolic, group)

    def steps(
        group: PeerClass, forces: Sequence[ForceInput], count: int, durations: Sequence[Fraction]
    ) -> list[Matrix]:
        plain = site(group)
        moving = np.concatenate([plain.a, plain.b, np.zeros((len(plain.a), count))], axis=1).astype(object)
        for place, push in enumerate(forces, moving.shape[1] - count):
            moving[list(push.velocities), place] = inverses(group, push)
        if not any(isinstance(item, casadi.SX) for item in moving.flat):
            return [matrix.astype(object) for matrix in steps_in_floats(group, forces, count, durations)]
        return [_step(moving, group.site.a, float(duration)) for duration in durations]

    return FrameNumbers(site, inverses, steps, SYMBOLS)


def _step(moving: Matrix, now: Matrix, seconds: float) -> Matrix:
    """Return [F G] for [A B] and a duration, of expressions; `now` is A in the scene's own numbers."""
    n, width = moving.shape
    generator = casadi.SX(width, width)
    generator[:n, :] = _matrix(moving) * seconds
    size = float(np.abs(now).sum(axis=1).max(initial=0.0)) * seconds
    halvings = max(0, math.ceil(math.log2(max(size * SPAN, 1.0))))
    small = generator / 2**halvings
    expression = casadi.SX.eye(width)
    for term in range(TERMS, 0, -1):
        expression = casadi.SX.eye(width) + casadi.mtimes(small, expression) / term
    for _ in range(halvings):
        expression = casadi.mtimes(expression, expression)
    return _array(expression[:n, :])


def _plain(item: Any) -> Any:
    """Return an expression, as a float if it is one."""
    value = casadi.SX(item)
    return float(value) if value.is_constant() else value


def _array(matrix: Any) -> Matrix:
    """Return CasADi's matrix as an array whose constants are floats."""
    values = np.zeros(matrix.shape, dtype=object)
    for row, column in zip(*matrix.sparsity().get_triplet(), strict=True):
        values[row, column] = _plain(matrix[row, column])
    return values


def _matrix(block: Matrix) -> Any:
    """Return an array as CasADi's matrix, sparse where it is zero."""
    expression = casadi.SX(*block.shape)
    for place in np.ndindex(block.shape):
        if isinstance(block[place], casadi.SX) or block[place]:
            expression[place] = block[place]
    return expression


SYMBOLS = Arithmetic(
    multiply=lambda left, right: _array(casadi.mtimes(_matrix(left), _matrix(right))),
    add=lambda values, other: _array(_matrix(values) + _matrix(other)),
    subtract=lambda values, other: _array(_matrix(values) - _matrix(other)),
    exact=lambda matrix: matrix.astype(object),
    vanishes=lambda matrix: not _matrix(matrix).nnz(),
)
