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
from apc.exports.identifiers import ExportedSignal, words
from apc.exports.lifted import FrameNumbers, StateSpace, lifted, peers_of, state_space, steps_in_floats
from apc.lifting.devices import ForceInput
from apc.lifting.interval_arithmetic import Arithmetic
from apc.lifting.model_numbers import PeerIndices
from apc.lifting.numeric_model import numeric_model
from apc.linearization.linear_subsystem import LinearSubsystem
from apc.linearization.linearize import subsystem_of_entries
from apc.network.nominal_criterion import refuse_channel_number
from apc.parameter_values.parameter_names import ParameterRef, find, overlap, times_of, unit_of
from apc.parameter_values.parameters import free_values
from apc.spectrum.peer_classes import PeerClass
from apc.timing.communication_graph import CommunicationGraph

Matrix = NDArray[Any]

OPTION = "--symbolic"

# The factor by which Aτ may exceed its value in the model without loss of accuracy, and the number of terms
# of the series: for ‖Aτ‖ ≤ 1 the remainder is less than 1/17!, 3e-15.
SPAN, TERMS = 64, 16


def state_space_of(model: Model, *, open_at: str = "", symbolic: Sequence[str] = ()) -> StateSpace:
    """Return the state space of a model, with its matrices as a function of some parameters.

    Parameters
    ----------
    model, open_at
        As for `lifted.state_space`.
    symbolic
        The names of parameters of the model or of a group; without any, the matrices are constant.

    Raises
    ------
    ApcError
        E622 no such parameter; E954 a time, or a model whose slopes depend on its start; and those of
        `lifted.state_space`.
    """
    space = state_space(model, open_at=open_at)
    if not symbolic:
        return space
    parameter_refs = _parameter_refs(model, symbolic)
    ports = tuple(ExportedSignal(ref.label, unit_of(model, ref.name)) for ref in parameter_refs)
    symbols = [casadi.SX.sym(word) for word in words(ports)]
    numeric = prepare_at_start(numeric_model(model), parameter_refs)
    if numeric is None:
        message = "the point of linearization depends on more than the parameters"
        raise ApcError(Diagnostic("E954", SourceLocation(OPTION), message, advice=f"omit {OPTION}"))
    peer_classes, comm_graph = peers_of(numeric)
    peer_classes = tuple(
        part for peer_class in peer_classes for part in _split_by_groups(peer_class, comm_graph)
    )
    values = dict(zip(parameter_refs, symbols, strict=True))

    def vector(peer_class: PeerClass) -> Any:
        """Return the parameters of a class's first peer as CasADi expressions."""
        index = comm_graph.group_of(peer_class.peers.first)
        peer = peer_class.peers.first - int(comm_graph.starts[index])
        entries = free_values(model, model.groups[index], peer, values, symbolic_function)
        return casadi.vertcat(*map(casadi.SX, entries))

    blocks, _, _ = lifted(model, peer_classes, comm_graph, open_at, _numbers(vector))
    function = casadi.Function(
        "state_space", symbols, [*map(_matrix, blocks)], words(ports), ["A", "B", "C", "D"]
    )
    return replace(space, symbolic=ports, function=function)


def _parameter_refs(model: Model, names: Sequence[str]) -> list[ParameterRef]:
    """Return references to the free parameters.

    Raises
    ------
    ApcError
        E622 no such parameter; E954 a time, or a parameter named twice.
    """
    parameter_refs: list[ParameterRef] = []
    for name in names:
        free = find(model, name, SourceLocation(OPTION))
        if times_of(model, free.name):
            message = f"{free.label} is a time; the event order and the states depend on it"
            advice = f'set single values with --set {free.label}="…"'
            raise ApcError(Diagnostic("E954", SourceLocation(OPTION), message, advice=advice))
        refuse_channel_number(model, free, SourceLocation(OPTION))
        if any(overlap(model, free, other) for other in parameter_refs):
            message = f"{free.label} is given twice"
            raise ApcError(Diagnostic("E954", SourceLocation(OPTION), message, fix=f"{OPTION} {free.label}"))
        parameter_refs.append(free)
    return parameter_refs


def _split_by_groups(peer_class: PeerClass, comm_graph: CommunicationGraph) -> list[PeerClass]:
    """Return a class of equal peers split by the model's groups, as a parameter of one group may be free."""
    runs = itertools.groupby(peer_class.peers.runs, key=lambda run: comm_graph.group_of(run.start))
    parts = [PeerIndices(tuple(runs_of_group)) for _, runs_of_group in runs]
    return [replace(peer_class, peers=peers, count=len(peers)) for peers in parts]


def _numbers(vector: Callable[[PeerClass], Any]) -> FrameNumbers:
    """Return the numerical parts of a frame, as CasADi expressions of each class's parameters (n_p,)."""

    def values(function: Any, peer_class: PeerClass) -> list[Any]:
        """Return the nonzeros of a function at a class's parameters, with zeros for all other arguments."""
        other_arguments = [casadi.DM.zeros(*function.size_in(index)) for index in range(function.n_in() - 2)]
        return [
            _constant_or_expression(nonzero)
            for nonzero in function(*other_arguments, vector(peer_class), 0).nonzeros()
        ]

    def subsystem(peer_class: PeerClass) -> LinearSubsystem:
        """Return the matrices of a peer class."""
        return subsystem_of_entries(
            peer_class.jacobians, values(peer_class.jacobians.function, peer_class), 0
        )

    def inverses(peer_class: PeerClass, push: ForceInput) -> list[Any]:
        """Return the effects of a force on velocities, per newton."""
        return values(push.symbolic, peer_class)

    def steps(
        peer_class: PeerClass, forces: Sequence[ForceInput], count: int, durations: Sequence[Fraction]
    ) -> list[Matrix]:
        """Return [F G] for each duration, with `count` inputs after the holds."""
        matrices = subsystem(peer_class)
        generator_rows = np.concatenate(
            [matrices.a, matrices.b, np.zeros((len(matrices.a), count))], axis=1
        ).astype(object)
        for index, push in enumerate(forces, generator_rows.shape[1] - count):
            generator_rows[list(push.velocities), index] = inverses(peer_class, push)
        if not any(isinstance(item, casadi.SX) for item in generator_rows.flat):
            return [matrix.astype(object) for matrix in steps_in_floats(peer_class, forces, count, durations)]
        return [_step(generator_rows, peer_class.subsystem.a, float(duration)) for duration in durations]

    return FrameNumbers(subsystem, inverses, steps, SYMBOLS)


def _step(generator_rows: Matrix, nominal_a: Matrix, seconds: float) -> Matrix:
    """Return [F G] for [A B] of expressions and a duration.

    `nominal_a` is A at the model's parameter values.
    """
    n, width = generator_rows.shape
    generator = casadi.SX(width, width)
    generator[:n, :] = _matrix(generator_rows) * seconds
    size = float(np.abs(nominal_a).sum(axis=1).max(initial=0.0)) * seconds
    halvings = max(0, math.ceil(math.log2(max(size * SPAN, 1.0))))
    scaled = generator / 2**halvings
    expression = casadi.SX.eye(width)
    for term in range(TERMS, 0, -1):
        expression = casadi.SX.eye(width) + casadi.mtimes(scaled, expression) / term
    for _ in range(halvings):
        expression = casadi.mtimes(expression, expression)
    return _array(expression[:n, :])


def _constant_or_expression(item: Any) -> Any:
    """Return an expression, converted to a float if it is constant."""
    value = casadi.SX(item)
    return float(value) if value.is_constant() else value


def _array(matrix: Any) -> Matrix:
    """Return a CasADi matrix as an array whose constants are floats."""
    values = np.zeros(matrix.shape, dtype=object)
    for row, column in zip(*matrix.sparsity().get_triplet(), strict=True):
        values[row, column] = _constant_or_expression(matrix[row, column])
    return values


def _matrix(block: Matrix) -> Any:
    """Return an array as a CasADi matrix, sparse where it is zero."""
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
