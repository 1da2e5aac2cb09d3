"""The Jacobians of a peer type as one CasADi function, and the points where its equations are not smooth.

Takes: a peer type of a `Model`; CasADi expressions.
Gives: `SubsystemJacobians` (built once for a peer type), `jacobians`, `with_equations`; `EdgeJacobian`,
`edge_name`; `structural_pattern`; `guards_of`, `lookups_of`, `nodes_of`.
Guarantees: structural patterns come from CasADi, for all parameter values; an affine peer type has constant
Jacobians. Every comparison, max, min, abs, sign, floor, ceil and table that depends on a variable is found,
each once.
Does not: evaluate Jacobians (see `linearize`); find the sign changes of a guard (see `forcing`, `integrate`).

A receive over an edge function, r = op_j e(x, u, m, s_j), is linear in the received values and in the
receiver's x, u and m: the slopes ∂r/∂x and so on are added to the tick's X, U and M; ∂e/∂s weights the
received values (see `modes.couple`).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import ClockPartition, PeerType, Receive
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.interpolation import Interpolation, function_of, jacobian, table_of
from apc.linearization.linear_subsystem import LinearSubsystem, Matrix, assemble, with_local_parts

# Peer types with cached Jacobians.
CACHE_SIZE = 64

_BINARY = {casadi.OP_LT, casadi.OP_LE, casadi.OP_EQ, casadi.OP_NE, casadi.OP_FMIN, casadi.OP_FMAX}
_UNARY = {casadi.OP_FABS, casadi.OP_SIGN}
_STEPS = {casadi.OP_FLOOR, casadi.OP_CEIL}
DECIDING = _BINARY | _UNARY


def guards_of(expression: Any, moving: Any) -> list[Any]:
    """Return the guards of an expression: functions that change sign where it is not smooth.

    The breakpoints of tables are included.

    Parameters
    ----------
    expression
        A column, `casadi.SX`.
    moving
        The symbols that vary; guards without any of them are left out.
    """
    result = []
    for node in nodes_of(expression):
        parts = [node.dep(i) for i in range(node.n_dep())]
        code = node.op()
        if code in _BINARY:
            result.append(parts[0] - parts[1])
        elif code in _UNARY:
            result.append(parts[0])
        elif code in _STEPS:
            # Changes sign at each integer and half-way between, where the split has no effect.
            result.append(_integer_indicator(parts[0]))
    result += [
        _integer_indicator(function_of(table.positions())(argument))
        for table, argument in lookups_of(expression)
    ]
    return [item for item in result if casadi.depends_on(item, moving)]


def lookups_of(expression: Any) -> list[tuple[Interpolation, Any]]:
    """Return each table lookup in an expression: the table, and its argument as `casadi.SX`."""
    calls = [node for node in nodes_of(expression) if node.op() == casadi.OP_CALL]
    return [(table_of(call.which_function()), call.dep(0)) for call in calls]


def _integer_indicator(expression: Any) -> Any:
    """Return a function that changes sign where an expression is an integer."""
    return casadi.sin(np.pi * expression)


def nodes_of(expression: Any) -> Iterator[Any]:
    """Yield all nodes of an expression, each once."""
    visited = set()
    pending = [expression[i] for i in range(expression.numel())]
    while pending:
        node = pending.pop()
        key = node.element_hash()
        if key not in visited:
            visited.add(key)
            pending += [node.dep(i) for i in range(node.n_dep())]
            yield node


@dataclass(frozen=True, slots=True)
class EdgeJacobian:
    """A receive's edge function for one sender, with its slopes.

    `function(x, u, m, s, p, t)` is a column: the value, then the slopes over x, u, m and s. `affine` states
    that the slopes are constant, `timed` that some depend on time.
    """

    function: Any  # casadi.Function
    affine: bool
    timed: bool


@dataclass(frozen=True, slots=True, eq=False)
class SubsystemJacobians:
    """The Jacobians of a peer type as a CasADi function of (x, u, m, r, p, t); m and r of all clocks.

    The function's one output is every matrix of a `LinearSubsystem`, in order, column-major, without
    structural zeros; `shapes` are the shapes of these matrices. `edges` are the edge functions of its
    receives by (clock partition, receive). `timed` states that some entry depends on time, even if only by a
    switch (see `switches.varying_slopes`). `equations` is the peer type whose functions are differentiated:
    `peer_type`, or one of its linear pieces. `ties`, at the start values, is a function of the parameters
    that is above 0 at a tie (see `linearization.kinks`).
    """

    peer_type: PeerType
    function: Any  # casadi.Function
    shapes: tuple[tuple[int, int], ...]
    pattern: LinearSubsystem
    affine: bool
    timed: bool
    edges: Mapping[tuple[int, int], EdgeJacobian]
    equations: PeerType
    ties: Any | None = None  # casadi.Function

    @property
    def parameters_suffice(self) -> bool:
        """Whether the matrices depend on the parameters alone, for any start values and received values.

        Peers of equal parameters then have equal matrices, and a population of them splits into modes.
        """
        return self.affine and not self.edges

    @property
    def walkable(self) -> bool:
        """Whether the function is a list of scalar operations, without a Newton solver."""
        return bool(self.function.is_a("SXFunction"))


@functools.lru_cache(maxsize=CACHE_SIZE)
def jacobians(peer_type: PeerType) -> SubsystemJacobians:
    """Return a peer type's Jacobian functions, cached; evaluating them in `linearize` is then cheap.

    Raises
    ------
    ApcError
        E807 a nonlinear loop in a peer type that also has an edge function.
    """
    _refuse_loop_with_edges(peer_type)
    # With a nonlinear loop the function is MX; its Jacobian follows from the implicit function theorem.
    plain = all(function.is_a("SXFunction") for function in _functions(peer_type))
    symbol: Any = casadi.SX.sym if plain else casadi.MX.sym
    x, u = symbol("x", len(peer_type.states)), symbol("u", len(peer_type.holds))
    p, t = symbol("p", len(peer_type.parameters)), symbol("t")
    memories = [symbol("m", len(partition.memories)) for partition in peer_type.clocks]
    received = [symbol("r", len(partition.receives)) for partition in peer_type.clocks]

    derivative = peer_type.derivative(x, u, p, t)
    values = [derivative]
    blocks = [jacobian(derivative, x), jacobian(derivative, u)]
    for partition, m, r in zip(peer_type.clocks, memories, received, strict=True):
        outputs = partition.tick(x, u, m, r, p, t)
        values.append(outputs)
        blocks += [jacobian(outputs, variables) for variables in (x, u, m, r)]
    for sending in peer_type.sends:
        sent = sending.send(x, u, p, t)
        values.append(sent)
        blocks += [jacobian(sent, variables) for variables in (x, u)]

    m_all, r_all = casadi.vertcat(*memories), casadi.vertcat(*received)
    # With many states most entries are structural zeros, without operations and outputs.
    flat = casadi.vertcat(*(casadi.vec(block) for block in blocks))
    moving = casadi.vertcat(x, u, m_all, r_all, t)
    edges = {
        (p, index): _edge(peer_type, partition, receive)
        for p, partition in enumerate(peer_type.clocks)
        for index, receive in enumerate(partition.receives)
        if edge_name(partition, receive)
    }
    non_time = casadi.vertcat(x, u, m_all, r_all)
    affine = (
        plain
        and not _depends(flat, moving)
        # A force that jumps has the same slopes on both sides.
        and not guards_of(casadi.vertcat(*values), non_time)
        and all(edge.affine for edge in edges.values())
    )
    initial_reception = [_reception_slopes(peer_type, p, edges) for p in range(len(peer_type.clocks))]
    pattern = assemble(
        peer_type, affine, _patterns(peer_type, blocks), [received for _, received in initial_reception]
    )
    own_slopes = [parts for parts, _ in initial_reception]
    return SubsystemJacobians(
        peer_type=peer_type,
        function=casadi.Function("jacobians", [x, u, m_all, r_all, p, t], [flat]),
        shapes=tuple((int(block.size1()), int(block.size2())) for block in blocks),
        pattern=with_local_parts(pattern, own_slopes, np.logical_or, lambda a, b: a[:, None] & b[None, :]),
        affine=affine,
        timed=_depends(flat, t) or any(edge.timed for edge in edges.values()),
        edges=edges,
        equations=peer_type,
    )


def with_equations(base: SubsystemJacobians, peer_type: PeerType) -> SubsystemJacobians:
    """Return the Jacobians of other equations of a peer type: one of its linear pieces.

    Parameters
    ----------
    base
        The peer type's ordinary Jacobians: states, start values and structural patterns are taken from them,
        so that every piece has the same frame and the same states.
    peer_type
        The peer type with other equations.
    """
    return replace(jacobians(peer_type), peer_type=base.peer_type, pattern=base.pattern)


def _patterns(peer_type: PeerType, blocks: Sequence[Any]) -> list[NDArray[np.bool_]]:
    """Return the structural pattern of each block; for a clock, the union over its variants."""
    heights = [0, 0, *(len(clock.outputs) for clock in peer_type.clocks for _ in range(4))]
    masks = []
    for block, height in itertools.zip_longest(blocks, heights, fillvalue=0):
        pattern = structural_pattern(block)
        if height:
            variants = pattern.reshape(len(pattern) // height, height, pattern.shape[1])
            pattern = np.logical_or.reduce(variants, axis=0)
        masks.append(pattern)
    return masks


def edge_name(partition: ClockPartition, receive: Receive) -> str:
    """Return the name of a receive with an edge function, "" for a plain sum or mean."""
    plain = receive.edge is None and receive.operator in ("sum", "mean")
    return "" if plain else f"{partition.clock}: {receive.name}"


def structural_pattern(block: Any) -> NDArray[np.bool_]:
    """Return the structural nonzeros of a CasADi matrix, or of a sparsity, as truth values."""
    sparsity = block if isinstance(block, casadi.Sparsity) else block.sparsity()
    pattern = np.zeros(sparsity.shape, dtype=np.bool_)
    rows, columns = sparsity.get_triplet()
    pattern[rows, columns] = True
    return pattern


def _depends(expression: Any, symbols: Any) -> bool:
    """Return whether an expression, which may be empty, depends on any of these symbols."""
    return bool(expression.numel() and casadi.depends_on(expression, symbols))


def _functions(peer_type: PeerType) -> list[Any]:
    """Return the functions of a peer type that are linearized, except edge functions."""
    return [
        peer_type.derivative,
        *(clock.tick for clock in peer_type.clocks),
        *(send.send for send in peer_type.sends),
    ]


def _refuse_loop_with_edges(peer_type: PeerType) -> None:
    """Raise ApcError E807 for a peer type with both a nonlinear loop and an edge function."""
    received = [receive for part in peer_type.clocks for receive in part.receives if edge_name(part, receive)]
    edges = [receive.edge for receive in received if receive.edge is not None]
    if received and not all(function.is_a("SXFunction") for function in (*_functions(peer_type), *edges)):
        message = (
            "has a nonlinear loop and a function of individual senders; this combination can't be linearized"
        )
        raise ApcError(Diagnostic("E807", SourceLocation(peer_type.name), message))


def _edge(peer_type: PeerType, partition: ClockPartition, receive: Receive) -> EdgeJacobian:
    """Return a receive's edge function with its slopes; the default edge function is the channel itself."""
    symbol = casadi.SX.sym
    channels = next(
        (len(send.channels) for send in peer_type.sends if send.link == receive.link), receive.channel + 1
    )
    x, u, m = (
        symbol("x", len(peer_type.states)),
        symbol("u", len(peer_type.holds)),
        symbol("m", len(partition.memories)),
    )
    s = symbol("s", receive.edge.numel_in(3) if receive.edge is not None else channels)
    p, t = symbol("p", len(peer_type.parameters)), symbol("t")
    value = s[receive.channel] if receive.edge is None else receive.edge(x, u, m, s, p, t)
    slopes = casadi.densify(jacobian(value, casadi.vertcat(x, u, m, s)).T)
    smooth = receive.operator in ("sum", "mean") and not guards_of(value, casadi.vertcat(x, u, m, s))
    varies = _depends(slopes, casadi.vertcat(x, u, m, s, t))
    function = casadi.Function("edge", [x, u, m, s, p, t], [casadi.vertcat(casadi.densify(value), slopes)])
    return EdgeJacobian(function, smooth and not varies, _depends(slopes, t))


def _reception_slopes(
    peer_type: PeerType, p: int, edges: Mapping[tuple[int, int], EdgeJacobian]
) -> tuple[list[Matrix | None], tuple[tuple[int, ...], ...]]:
    """Return, for each receive of a partition, the pattern of its slopes over (x, u, m), and its channels."""
    partition = peer_type.clocks[p]
    own_count = len(peer_type.states) + len(peer_type.holds) + len(partition.memories)
    matrices: list[Matrix | None] = []
    channels: list[tuple[int, ...]] = []
    for index, receive in enumerate(partition.receives):
        if (p, index) not in edges:
            matrices.append(None)
            channels.append((receive.channel,))
            continue
        function = edges[p, index].function
        symbols = function.sx_in()
        moving = casadi.vertcat(*symbols[:4])
        depends = structural_pattern(jacobian(function(*symbols)[0], moving))[0]
        matrices.append(depends[:own_count])
        channels.append(tuple(np.flatnonzero(depends[own_count:]).tolist()))
    return matrices, tuple(channels)
