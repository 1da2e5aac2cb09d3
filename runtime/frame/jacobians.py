"""The Jacobians of a kind, as one CasADi function of everything they may depend on; where one is not smooth.

Takes: a kind of a `Model`; CasADi expressions.
Gives: `SubsystemJacobians` (built once a kind), `jacobians`, `with_equations`; `EdgeJacobian`, `edge_name`;
`structural_pattern`; `guards_of`, `lookups_of`, `nodes_of`.
Guarantees: structural patterns come from CasADi, whatever the numbers; a kind that is called affine has the
same Jacobians everywhere. Every comparison, max, min, abs, sign, floor, ceil and table that hangs on what
moves is found, each once.
Does not: evaluate Jacobians (see `linearize`); find when a guard changes sign (see `forcing`, `integrate`).

A receive over an edge function, r = op_j e(x, u, m, s_j), is linear in what the site hears and in its own x,
u and m: its own part, ∂r/∂x and so on, is part of the tick's X, U and M; ∂e/∂s weighs what it hears (see
`modes.couple`).
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
from apc.frame.site import LinearSubsystem, Matrix, assemble, with_own_parts

# Kinds whose Jacobians are remembered.
KEPT = 64

_BINARY = {casadi.OP_LT, casadi.OP_LE, casadi.OP_EQ, casadi.OP_NE, casadi.OP_FMIN, casadi.OP_FMAX}
_UNARY = {casadi.OP_FABS, casadi.OP_SIGN}
_STEPS = {casadi.OP_FLOOR, casadi.OP_CEIL}
DECIDING = _BINARY | _UNARY


def guards_of(expression: Any, moving: Any, *, tables: bool = True) -> list[Any]:
    """Return what changes sign where an expression is not smooth.

    Parameters
    ----------
    expression
        A column, `casadi.SX`.
    moving
        The symbols that change; what hangs on none of them is left out.
    tables
        Whether the rows of tables are told, too.
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
            # Changes sign at each whole number, and again half-way, where nothing is split in vain.
            result.append(_whole(parts[0]))
    if tables:
        result += [_whole(function_of(table.positions())(at)) for table, at in lookups_of(expression)]
    return [item for item in result if casadi.depends_on(item, moving)]


def lookups_of(expression: Any) -> list[tuple[Interpolation, Any]]:
    """Return each table that is looked up in an expression, with where in it, `casadi.SX`."""
    calls = [node for node in nodes_of(expression) if node.op() == casadi.OP_CALL]
    return [(table_of(call.which_function()), call.dep(0)) for call in calls]


def _whole(expression: Any) -> Any:
    """Return what changes sign where an expression is a whole number."""
    return casadi.sin(np.pi * expression)


def nodes_of(expression: Any) -> Iterator[Any]:
    """Yield all that an expression is made of, each once."""
    seen = set()
    work = [expression[i] for i in range(expression.numel())]
    while work:
        node = work.pop()
        known = node.element_hash()
        if known not in seen:
            seen.add(known)
            work += [node.dep(i) for i in range(node.n_dep())]
            yield node


@dataclass(frozen=True, slots=True)
class EdgeJacobian:
    """What a receive does with one sender: its edge function with its slopes.

    `function(x, u, m, s, p, t)` is a column: the value, then the slopes over x, u, m and s. `affine` says
    that these hold everywhere, `timed` that some depend on time.
    """

    function: Any  # casadi.Function
    affine: bool
    timed: bool


@dataclass(frozen=True, slots=True, eq=False)
class SubsystemJacobians:
    """The Jacobians of a kind as one CasADi function of (x, u, m, r, p, t); m and r of all clocks in a row.

    The function's one output is every matrix of a `LinearSubsystem`, in order, column-major, less what is
    zero by structure; `shapes` cuts it. `edges` are those of its receives by (clock partition, receive).
    `timed` says that some entry depends on time, if only on whether something has switched (see
    `switches.varying_slopes`). `equations` is the kind whose functions are differentiated: `kind`, or one of
    its pieces. `ties`, where the start values are put in, is a function of the parameters that is above 0 at
    a tie (see `frame.kinks`).
    """

    kind: PeerType
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
        """Whether its matrices follow from its parameters alone, wherever it starts and whoever it hears.

        Peers of equal parameters then move alike, and a population of them splits in modes.
        """
        return self.affine and not self.edges

    @property
    def walkable(self) -> bool:
        """Whether the function is a list of scalar operations; one with a Newton solver inside isn't."""
        return bool(self.function.is_a("SXFunction"))


@functools.lru_cache(maxsize=KEPT)
def jacobians(kind: PeerType) -> SubsystemJacobians:
    """Build a kind's Jacobian functions, once for as long as it is remembered; `linearize` is then cheap.

    Raises
    ------
    ApcError
        E807 a nonlinear loop in a kind that also looks at each sender by itself.
    """
    _refuse_loop_with_edges(kind)
    # What needs a nonlinear loop is an MX function; its Jacobian comes by the implicit function theorem.
    plain = all(function.is_a("SXFunction") for function in _functions(kind))
    symbol: Any = casadi.SX.sym if plain else casadi.MX.sym
    x, u = symbol("x", len(kind.states)), symbol("u", len(kind.holds))
    p, t = symbol("p", len(kind.parameters)), symbol("t")
    memories = [symbol("m", len(partition.memories)) for partition in kind.clocks]
    heard = [symbol("r", len(partition.receives)) for partition in kind.clocks]

    derivative = kind.derivative(x, u, p, t)
    values = [derivative]
    blocks = [jacobian(derivative, x), jacobian(derivative, u)]
    for partition, m, r in zip(kind.clocks, memories, heard, strict=True):
        outputs = partition.tick(x, u, m, r, p, t)
        values.append(outputs)
        blocks += [jacobian(outputs, of) for of in (x, u, m, r)]
    for sending in kind.sends:
        sent = sending.send(x, u, p, t)
        values.append(sent)
        blocks += [jacobian(sent, of) for of in (x, u)]

    m_all, r_all = casadi.vertcat(*memories), casadi.vertcat(*heard)
    # Of many states most entries are zero by structure: they are no operations and no outputs.
    flat = casadi.vertcat(*(casadi.vec(block) for block in blocks))
    moving = casadi.vertcat(x, u, m_all, r_all, t)
    edges = {
        (p, place): _edge(kind, partition, receive)
        for p, partition in enumerate(kind.clocks)
        for place, receive in enumerate(partition.receives)
        if edge_name(partition, receive)
    }
    inside = casadi.vertcat(x, u, m_all, r_all)
    affine = (
        plain
        and not _depends(flat, moving)
        # A force that jumps has the same slopes on either side.
        and not guards_of(casadi.vertcat(*values), inside)
        and all(edge.affine for edge in edges.values())
    )
    listening = [_listening(kind, p, edges) for p in range(len(kind.clocks))]
    pattern = assemble(kind, affine, _patterns(kind, blocks), [heard for _, heard in listening])
    own = [parts for parts, _ in listening]
    return SubsystemJacobians(
        kind=kind,
        function=casadi.Function("jacobians", [x, u, m_all, r_all, p, t], [flat]),
        shapes=tuple((int(block.size1()), int(block.size2())) for block in blocks),
        pattern=with_own_parts(pattern, own, np.logical_or, lambda a, b: a[:, None] & b[None, :]),
        affine=affine,
        timed=_depends(flat, t) or any(edge.timed for edge in edges.values()),
        edges=edges,
        equations=kind,
    )


def with_equations(base: SubsystemJacobians, kind: PeerType) -> SubsystemJacobians:
    """Return the Jacobians of other equations of a kind: one of its pieces.

    Parameters
    ----------
    base
        The kind's ordinary Jacobians: states, start values and structural patterns stay theirs, so that every
        piece has the same frame and the same states.
    kind
        The kind with other equations.
    """
    return replace(jacobians(kind), kind=base.kind, pattern=base.pattern)


def _patterns(kind: PeerType, blocks: Sequence[Any]) -> list[NDArray[np.bool_]]:
    """Return the pattern of each block; of a clock's, of all its variants together."""
    heights = [0, 0, *(len(clock.outputs) for clock in kind.clocks for _ in range(4))]
    masks = []
    for block, height in itertools.zip_longest(blocks, heights, fillvalue=0):
        pattern = structural_pattern(block)
        if height:
            variants = pattern.reshape(len(pattern) // height, height, pattern.shape[1])
            pattern = np.logical_or.reduce(variants, axis=0)
        masks.append(pattern)
    return masks


def edge_name(partition: ClockPartition, receive: Receive) -> str:
    """Return the name of a receive that looks at every sender by itself, "" for a plain sum or mean."""
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
    """Say whether an expression, which may be empty, depends on any of these symbols."""
    return bool(expression.numel() and casadi.depends_on(expression, symbols))


def _functions(kind: PeerType) -> list[Any]:
    """Return the functions that a linearization is of, but for edges."""
    return [kind.derivative, *(clock.tick for clock in kind.clocks), *(send.send for send in kind.sends)]


def _refuse_loop_with_edges(kind: PeerType) -> None:
    """Refuse what neither the scalar walk nor the implicit function theorem covers yet."""
    heard = [receive for part in kind.clocks for receive in part.receives if edge_name(part, receive)]
    edges = [receive.edge for receive in heard if receive.edge is not None]
    if heard and not all(function.is_a("SXFunction") for function in (*_functions(kind), *edges)):
        what = (
            "has a nonlinear loop and a reduction that looks at each sender by itself; "
            "together they can't be linearized"
        )
        raise ApcError(Diagnostic("E807", SourceLocation(kind.name), what))


def _edge(kind: PeerType, partition: ClockPartition, receive: Receive) -> EdgeJacobian:
    """Build a receive's edge function with its slopes; without one, it is the channel itself."""
    symbol = casadi.SX.sym
    channels = next(
        (len(send.channels) for send in kind.sends if send.link == receive.link), receive.channel + 1
    )
    x, u, m = (
        symbol("x", len(kind.states)),
        symbol("u", len(kind.holds)),
        symbol("m", len(partition.memories)),
    )
    s = symbol("s", receive.edge.numel_in(3) if receive.edge is not None else channels)
    p, t = symbol("p", len(kind.parameters)), symbol("t")
    value = s[receive.channel] if receive.edge is None else receive.edge(x, u, m, s, p, t)
    slopes = casadi.densify(jacobian(value, casadi.vertcat(x, u, m, s)).T)
    smooth = receive.operator in ("sum", "mean") and not guards_of(value, casadi.vertcat(x, u, m, s))
    moves = _depends(slopes, casadi.vertcat(x, u, m, s, t))
    function = casadi.Function("edge", [x, u, m, s, p, t], [casadi.vertcat(casadi.densify(value), slopes)])
    return EdgeJacobian(function, smooth and not moves, _depends(slopes, t))


def _listening(
    kind: PeerType, p: int, edges: Mapping[tuple[int, int], EdgeJacobian]
) -> tuple[list[Matrix | None], tuple[tuple[int, ...], ...]]:
    """Return, for each receive of a partition, the pattern of its own part and the channels it depends on."""
    partition = kind.clocks[p]
    inside = len(kind.states) + len(kind.holds) + len(partition.memories)
    matrices: list[Matrix | None] = []
    channels: list[tuple[int, ...]] = []
    for place, receive in enumerate(partition.receives):
        if (p, place) not in edges:
            matrices.append(None)
            channels.append((receive.channel,))
            continue
        function = edges[p, place].function
        symbols = function.sx_in()
        moving = casadi.vertcat(*symbols[:4])
        depends = structural_pattern(jacobian(function(*symbols)[0], moving))[0]
        matrices.append(depends[:inside])
        channels.append(tuple(np.flatnonzero(depends[inside:]).tolist()))
    return matrices, tuple(channels)
