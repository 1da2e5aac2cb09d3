"""A state space as a function of some parameters of a model.

Takes: a `Model`, names of its parameters. Gives: `state_space_of`.
Guarantees: parameters computed from a free parameter by a formula follow it. At the model's parameter values
the matrices equal those of `lifted.state_space`, except for rounding.
Does not: support free times: another delay changes the event order and the number of states.

If a free parameter, such as a mass, enters the continuous dynamics, e^{Aτ} is computed by scaling and
squaring of its Taylor series. The number of squarings makes the nominal Aτ small; parameter values up to
`SPAN` times as large keep full accuracy.
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
from apc.compiler.expression_data import symbolic as symbolic_function
from apc.eigen.peer_classes import PeerClass
from apc.exports.identifiers import ExportedSignal, words
from apc.exports.lifted import FrameNumbers, StateSpace, lifted, peers_of, state_space, steps_in_floats
from apc.frame.communication_graph import CommunicationGraph
from apc.frame.devices import ForceInput
from apc.frame.interval_arithmetic import Arithmetic
from apc.frame.linear_subsystem import LinearSubsystem
from apc.frame.linearize import subsystem_of_entries
from apc.frame.numeric_model import PeerIndices, prepare
from apc.frame.parameter_names import ParameterRef, find, overlap, times_of, unit_of
from apc.frame.parameters import free_values
from apc.network.nominal_criterion import refuse_channel_number

Matrix = NDArray[Any]

OPTION = "--symbolic"

# How many times as large Aτ may be as in the model before the series ends too soon, and its terms: of
# ‖Aτ‖ ≤ 1 the rest is less than 1/17!, 3e-15.
SPAN, TERMS = 64, 16


def state_space_of(system: Model, *, open_at: str = "", symbolic: Sequence[str] = ()) -> StateSpace:
    """Lift a model, with its matrices as a function of some numbers.

    Parameters
    ----------
    system, open_at
        As for `lifted.state_space`.
    symbolic
        Parameters of the model or of a group; none gives the matrices alone.

    Raises
    ------
    ApcError
        E622 no such parameter; E954 a time, or a model whose start decides its slopes; and those of
        `lifted.state_space`.
    """
    space = state_space(system, open_at=open_at)
    if not symbolic:
        return space
    parameter_refs = _parameter_refs(system, symbolic)
    ports = tuple(ExportedSignal(ref.label, unit_of(system, ref.name)) for ref in parameter_refs)
    symbols = [casadi.SX.sym(word) for word in words(ports)]
    prepared = prepare_at_start(system, prepare(system), parameter_refs)
    if prepared is None:
        message = "where the topology is linearized does not follow from its numbers alone"
        raise ApcError(Diagnostic("E954", SourceLocation(OPTION), message, hint=f"no {OPTION}"))
    groups, exchange = peers_of(system, prepared=prepared)
    groups = tuple(part for group in groups for part in _by_groups(group, exchange))
    values = dict(zip(parameter_refs, symbols, strict=True))

    def vector(group: PeerClass) -> Any:
        index = exchange.group_of(group.peers.first)
        peer = group.peers.first - int(exchange.starts[index])
        listed = free_values(system, system.groups[index], peer, values, symbolic_function)
        return casadi.vertcat(*map(casadi.SX, listed))

    blocks, _, _ = lifted(system, groups, exchange, open_at, _numbers(vector))
    function = casadi.Function(
        "state_space", symbols, [*map(_matrix, blocks)], words(ports), ["A", "B", "C", "D"]
    )
    return replace(space, symbolic=ports, function=function)


def _parameter_refs(system: Model, names: Sequence[str]) -> list[ParameterRef]:
    """Return the free parameters."""
    parameter_refs: list[ParameterRef] = []
    for name in names:
        free = find(system, name, SourceLocation(OPTION))
        if times_of(system, free.name):
            message = f"{free.label} is a time: another one is another order of events, and another state"
            hint = f'one value at a time: --set {free.label}="…"'
            raise ApcError(Diagnostic("E954", SourceLocation(OPTION), message, hint=hint))
        refuse_channel_number(system, free, SourceLocation(OPTION))
        if any(overlap(system, free, other) for other in parameter_refs):
            message = f"{free.label} is named twice"
            raise ApcError(Diagnostic("E954", SourceLocation(OPTION), message, hint=f"{OPTION} {free.label}"))
        parameter_refs.append(free)
    return parameter_refs


def _by_groups(group: PeerClass, exchange: CommunicationGraph) -> list[PeerClass]:
    """Split equal peers by the model's groups: a parameter of one group may be free."""
    runs = itertools.groupby(group.peers.runs, key=lambda run: exchange.group_of(run.start))
    parts = [PeerIndices(tuple(inside)) for _, inside in runs]
    return [replace(group, peers=peers, count=len(peers)) for peers in parts]


def _numbers(vector: Callable[[PeerClass], Any]) -> FrameNumbers:
    """Return the numerical parts of a frame as CasADi expressions of each group's parameter vector (n_p,)."""

    def values(function: Any, group: PeerClass) -> list[Any]:
        rest = [casadi.DM.zeros(*function.size_in(index)) for index in range(function.n_in() - 2)]
        return [_plain(nonzero) for nonzero in function(*rest, vector(group), 0).nonzeros()]

    def subsystem(group: PeerClass) -> LinearSubsystem:
        return subsystem_of_entries(group.jacobians, values(group.jacobians.function, group), 0)

    def inverses(group: PeerClass, push: ForceInput) -> list[Any]:
        return values(push.symbolic, group)

    def steps(
        group: PeerClass, forces: Sequence[ForceInput], count: int, durations: Sequence[Fraction]
    ) -> list[Matrix]:
        plain = subsystem(group)
        moving = np.concatenate([plain.a, plain.b, np.zeros((len(plain.a), count))], axis=1).astype(object)
        for index, push in enumerate(forces, moving.shape[1] - count):
            moving[list(push.velocities), index] = inverses(group, push)
        if not any(isinstance(item, casadi.SX) for item in moving.flat):
            return [matrix.astype(object) for matrix in steps_in_floats(group, forces, count, durations)]
        return [_step(moving, group.subsystem.a, float(duration)) for duration in durations]

    return FrameNumbers(subsystem, inverses, steps, SYMBOLS)


def _step(moving: Matrix, now: Matrix, seconds: float) -> Matrix:
    """Return [F G] for [A B] and a duration, of expressions; `now` is A in the model's own numbers."""
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
    for index in np.ndindex(block.shape):
        if isinstance(block[index], casadi.SX) or block[index]:
            expression[index] = block[index]
    return expression


SYMBOLS = Arithmetic(
    multiply=lambda left, right: _array(casadi.mtimes(_matrix(left), _matrix(right))),
    add=lambda values, other: _array(_matrix(values) + _matrix(other)),
    subtract=lambda values, other: _array(_matrix(values) - _matrix(other)),
    exact=lambda matrix: matrix.astype(object),
    vanishes=lambda matrix: not _matrix(matrix).nnz(),
)
