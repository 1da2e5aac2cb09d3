"""The linear equations of one site.

Takes: a kind of a `CompiledSystem` and its parameter vector.
Gives: `SiteJacobians` (built once a kind), `LinearSite` (one a parameter vector), `jacobians`, `linearize`,
`linearize_exact`, `linearize_rows`; `Edge`, `Listening`.
Guarantees: structural patterns come from CasADi, whatever the numbers; every matrix says what its rows and
columns are.
Does not: decide when anything happens (see `schedule`), or keep offsets: constant forces move the
equilibrium, not the spectrum.

    dx/dt = A x + B u          continuous
    y     = X x + U u + M m + R r    at a tick of a clock
    s     = X x + U u          at a tick of a link's clock

A receive over an edge function, r = op_j e(x, u, m, s_j), is linear in what the site hears and in its own x,
u and m: its own part, ∂r/∂x and so on, is part of the tick's X, U and M; ∂e/∂s weighs what it hears (see
`modes`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import PEERS, ClockPartition, Kind, Receive
from apc.compiler.errors import ApcError, Mistake, Place
from apc.runtime.frame.exact import evaluate_exact
from apc.runtime.frame.guards import guards_of

Matrix = NDArray[Any]

# Parameter vectors evaluated by one call: of many more at once, CasADi's copies take longer than its work.
MAPPED = 1024


@dataclass(frozen=True, slots=True)
class LinearTick:
    """What a clock partition computes: rows are its outputs; columns states, holds, memories, receives.

    `channels` are the rows of the link's channels that each receive depends on.
    """

    clock: str
    x: Matrix  # (n_y, n_x)
    u: Matrix  # (n_y, n_u)
    m: Matrix  # (n_y, n_m)
    r: Matrix  # (n_y, n_r)
    channels: tuple[tuple[int, ...], ...]


@dataclass(frozen=True, slots=True)
class LinearSend:
    """What a site sends over a link: rows are the channels; columns states and holds."""

    link: str
    x: Matrix  # (n_c, n_x)
    u: Matrix  # (n_c, n_u)


@dataclass(frozen=True, slots=True)
class LinearSite:
    """The matrices of one site, in floats, exact rationals, or truth values (a structural pattern).

    `affine` says that the site's own equations are affine, so that the matrices hold everywhere;
    otherwise they are the Jacobians at the start values.
    """

    kind: Kind
    affine: bool
    a: Matrix  # (n_x, n_x)
    b: Matrix  # (n_x, n_u)
    ticks: tuple[LinearTick, ...]  # in the order of Kind.clocks
    sends: tuple[LinearSend, ...]  # in the order of Kind.sends


@dataclass(frozen=True, slots=True)
class Edge:
    """What a receive does with one sender: its edge function with its slopes.

    `function(x, u, m, s, p, t)` is a column: the value, then the slopes over x, u, m and s. `affine` says
    that these hold everywhere.
    """

    function: Any  # casadi.Function
    affine: bool


@dataclass(frozen=True, slots=True)
class Listening:
    """What a site's receives (of all clocks in a row) are at the start, and their own parts.

    `values` (n_r,) are exact; `own` are the slopes over (x, u, m) of each receive, None for a plain one.
    """

    values: tuple[Fraction, ...]
    own: tuple[tuple[Fraction, ...] | None, ...]


@dataclass(frozen=True, slots=True)
class SiteJacobians:
    """The Jacobians of a kind as one CasADi function of (x, u, m, r, p, t); m and r of all clocks in a row.

    The function's one output is every matrix of a `LinearSite`, in order, column-major; `shapes` cuts it.
    `edges` are those of its receives by (clock partition, receive).
    """

    kind: Kind
    function: Any  # casadi.Function
    shapes: tuple[tuple[int, int], ...]
    pattern: LinearSite
    affine: bool
    edges: Mapping[tuple[int, int], Edge]

    @property
    def walkable(self) -> bool:
        """Whether the function is a list of scalar operations; one with a Newton solver inside isn't."""
        return bool(self.function.is_a("SXFunction"))


def _refuse_loop_with_edges(kind: Kind) -> None:
    """Refuse what neither the scalar walk nor the implicit function theorem covers yet."""
    functions = [kind.derivative, *(one.tick for one in kind.clocks), *(one.send for one in kind.sends)]
    receives = [receive for partition in kind.clocks for receive in partition.receives]
    edges = [receive.edge for receive in receives if receive.edge is not None]
    if edges and not all(function.is_a("SXFunction") for function in (*functions, *edges)):
        what = (
            "has a nonlinear loop and a reduction that looks at each sender by itself; "
            "together they can't be linearized"
        )
        raise ApcError(Mistake("E807", Place(kind.name), what))


def jacobians(kind: Kind) -> SiteJacobians:
    """Build a kind's Jacobian functions; do it once and keep the result, `linearize` is then cheap.

    Raises
    ------
    ApcError
        E807 a nonlinear loop in a kind that also looks at each sender by itself.
    """
    _refuse_loop_with_edges(kind)
    # A kind with a nonlinear loop has MX functions; their Jacobians come by the implicit function theorem.
    plain = kind.derivative.is_a("SXFunction")
    symbol: Any = casadi.SX.sym if plain else casadi.MX.sym
    x, u = symbol("x", len(kind.states)), symbol("u", len(kind.holds))
    p, t = symbol("p", len(kind.parameters)), symbol("t")
    memories = [symbol("m", len(partition.memories)) for partition in kind.clocks]
    heard = [symbol("r", len(partition.receives)) for partition in kind.clocks]

    derivative = kind.derivative(x, u, p, t)
    values = [derivative]
    blocks = [casadi.jacobian(derivative, x), casadi.jacobian(derivative, u)]
    for partition, m, r in zip(kind.clocks, memories, heard, strict=True):
        outputs = partition.tick(x, u, m, r, p, t)
        values.append(outputs)
        blocks += [casadi.jacobian(outputs, of) for of in (x, u, m, r)]
    for sending in kind.sends:
        sent = sending.send(x, u, p, t)
        values.append(sent)
        blocks += [casadi.jacobian(sent, of) for of in (x, u)]

    m_all, r_all = casadi.vertcat(*memories), casadi.vertcat(*heard)
    flat = casadi.vertcat(*(casadi.vec(casadi.densify(block)) for block in blocks))
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
        and not (flat.numel() and casadi.depends_on(flat, moving))
        # A force that jumps has the same slopes on either side.
        and not guards_of(casadi.vertcat(*values), inside)
        and all(edge.affine for edge in edges.values())
    )
    listening = [_listening(kind, p, edges) for p in range(len(kind.clocks))]
    pattern = _assemble(
        kind, affine, [_pattern(block) for block in blocks], [heard for _, heard in listening]
    )
    own = [parts for parts, _ in listening]
    return SiteJacobians(
        kind=kind,
        function=casadi.Function("jacobians", [x, u, m_all, r_all, p, t], [flat]),
        shapes=tuple((int(block.size1()), int(block.size2())) for block in blocks),
        pattern=_with_own_parts(pattern, own, np.logical_or, lambda a, b: a[:, None] & b[None, :]),
        affine=affine,
        edges=edges,
    )


def edge_name(partition: ClockPartition, receive: Receive) -> str:
    """Return the name of a receive that looks at every sender by itself, "" for a plain sum or mean."""
    plain = receive.edge is None and receive.operator in ("sum", "mean")
    return "" if plain else f"{partition.clock}: {receive.name}"


def _edge(kind: Kind, partition: ClockPartition, receive: Receive) -> Edge:
    """Build a receive's edge function with its slopes; without one, it is the channel itself."""
    symbol = casadi.SX.sym
    channels = next(
        (len(one.channels) for one in kind.sends if one.link == receive.link), receive.channel + 1
    )
    x, u, m = (
        symbol("x", len(kind.states)),
        symbol("u", len(kind.holds)),
        symbol("m", len(partition.memories)),
    )
    s = symbol("s", receive.edge.numel_in(3) if receive.edge is not None else channels)
    p, t = symbol("p", len(kind.parameters)), symbol("t")
    value = s[receive.channel] if receive.edge is None else receive.edge(x, u, m, s, p, t)
    slopes = casadi.densify(casadi.jacobian(value, casadi.vertcat(x, u, m, s)).T)
    smooth = receive.operator in ("sum", "mean") and not guards_of(value, casadi.vertcat(x, u, m, s))
    moves = casadi.depends_on(slopes, casadi.vertcat(x, u, m, s, t)) if slopes.numel() else False
    function = casadi.Function("edge", [x, u, m, s, p, t], [casadi.vertcat(casadi.densify(value), slopes)])
    return Edge(function, smooth and not moves)


def _listening(
    kind: Kind, p: int, edges: Mapping[tuple[int, int], Edge]
) -> tuple[list[Matrix | None], tuple[tuple[int, ...], ...]]:
    """Return, for each receive of a partition, the pattern of its own part and the channels it depends on."""
    partition = kind.clocks[p]
    inside = len(kind.states) + len(kind.holds) + len(partition.memories)
    own: list[Matrix | None] = []
    channels: list[tuple[int, ...]] = []
    for place, receive in enumerate(partition.receives):
        if (p, place) not in edges:
            own.append(None)
            channels.append((receive.channel,))
            continue
        function = edges[p, place].function
        symbols = function.sx_in()
        moving = casadi.vertcat(*symbols[:4])
        depends = _pattern(casadi.jacobian(function(*symbols)[0], moving))[0]
        own.append(depends[:inside])
        channels.append(tuple(np.flatnonzero(depends[inside:]).tolist()))
    return own, tuple(channels)


def _with_own_parts(
    site: LinearSite,
    own: Sequence[Sequence[Matrix | None]],
    add: Callable[[Matrix, Matrix], Matrix],
    multiply: Callable[[Matrix, Matrix], Matrix],
) -> LinearSite:
    """Return the site with each receive's own part over (x, u, m) in its ticks."""
    ticks = []
    for tick, parts in zip(site.ticks, own, strict=True):
        x, u, m = tick.x, tick.u, tick.m
        n_x, n_u = x.shape[1], u.shape[1]
        for place, part in enumerate(parts):
            if part is not None:
                column = tick.r[:, place]
                x = add(x, multiply(column, part[:n_x]))
                u = add(u, multiply(column, part[n_x : n_x + n_u]))
                m = add(m, multiply(column, part[n_x + n_u :]))
        ticks.append(replace(tick, x=x, u=u, m=m))
    return replace(site, ticks=tuple(ticks))


def linearize(
    site: SiteJacobians, parameters: NDArray[np.float64], listening: Listening | None = None
) -> LinearSite:
    """Return the matrices of a site, in floats.

    Parameters
    ----------
    site
        The kind's Jacobians.
    parameters
        The site's vector (n_p,), in the order of `Kind.parameters`.
    listening
        What the site hears at the start. Left out, the others stand where this site stands; a site with edge
        functions can't do without.
    """
    if listening is not None and site.edges:
        # A sum of slopes over many peers: rounded once, whatever cancels in it.
        exact = linearize_exact(site, parameters, listening)
        return _assemble(
            site.kind, site.affine, [one.astype(np.float64) for one in _matrices(exact)], _channels_of(site)
        )
    arguments = _start(site, [float(value) for value in parameters], float, listening)
    flat = np.asarray(site.function(*arguments), dtype=np.float64).ravel()
    return site_of_row(site, flat)


def linearize_exact(
    site: SiteJacobians, parameters: NDArray[np.float64], listening: Listening | None = None
) -> LinearSite:
    """Return the same matrices as `linearize` in exact rationals, as object arrays of `Fraction`.

    Parameters
    ----------
    site, parameters, listening
        As for `linearize`.
    """
    assert listening is not None or not site.edges, "who is heard decides what an edge function does"
    assert site.function.is_a("SXFunction"), "the solution of a nonlinear loop is no rational number"
    arguments = _start(site, [Fraction(float(value)) for value in parameters], Fraction, listening)
    flat = np.array(evaluate_exact(site.function, arguments)[0], dtype=object)
    exact = _assemble(site.kind, site.affine, _cut(flat, site.shapes), _channels_of(site))
    if listening is None:
        return exact
    rest = iter(listening.own)
    own = [
        [None if (part := next(rest)) is None else np.array(part, dtype=object) for _ in partition.receives]
        for partition in site.kind.clocks
    ]
    return _with_own_parts(exact, own, np.add, np.multiply.outer)


def linearize_rows(site: SiteJacobians, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrices of an affine site without edges for many parameter vectors (k, n_p), as rows.

    The rows (k, …) hold what `site_of_row` makes a site of.
    """
    assert site.affine and not site.edges, "the start matters"
    zeros = [np.zeros(site.function.numel_in(argument)) for argument in range(4)]
    rows = np.empty((len(parameters), site.function.numel_out(0)))
    many = None
    for start in range(0, len(parameters), MAPPED):
        some = parameters[start : start + MAPPED]
        if many is None or len(some) != MAPPED:
            many = site.function.map(len(some))
        flats = many(*(np.repeat(zero[:, None], len(some), axis=1) for zero in zeros), some.T, 0.0)
        rows[start : start + MAPPED] = np.asarray(flats, dtype=np.float64).reshape(-1, len(some)).T
    return rows + 0.0  # −0 and 0 are one number


def sites_of_rows(site: SiteJacobians, rows: NDArray[np.float64]) -> LinearSite:
    """Return the sites of many rows (k, …) of `linearize_rows` as one, matrices with a leading axis (k)."""
    matrices, start = [], 0
    for height, width in site.shapes:
        block = rows[:, start : start + height * width].reshape(len(rows), width, height)
        matrices.append(np.ascontiguousarray(block.swapaxes(1, 2)))
        start += height * width
    return _assemble(site.kind, site.affine, matrices, _channels_of(site))


def site_of_entries(site: SiteJacobians, flat: Sequence[Any]) -> LinearSite:
    """Return the site of a function's output over another kind of number (see `exact`)."""
    entries = np.empty(len(flat), dtype=object)
    entries[:] = list(flat)
    return _assemble(site.kind, site.affine, _cut(entries, site.shapes), _channels_of(site))


def site_of_row(site: SiteJacobians, row: NDArray[np.float64]) -> LinearSite:
    """Return the site of one row of `linearize_rows`."""
    return _assemble(site.kind, site.affine, _cut(row, site.shapes), _channels_of(site))


def start_values(
    site: SiteJacobians, parameters: Sequence[Any]
) -> tuple[list[Any], list[Any], list[list[Any]]]:
    """Return x, u and every clock partition's m at the start, where holds put out zero."""
    place = {name: index for index, name in enumerate(site.kind.parameters)}
    x = [parameters[place[state.start]] for state in site.kind.states]
    m = [[parameters[place[start]] for start in partition.starts] for partition in site.kind.clocks]
    return x, [0] * len(site.kind.holds), m


def start_sends(
    site: SiteJacobians, parameters: Sequence[Any], number: Callable[[float], Any] = Fraction
) -> dict[str, list[Any]]:
    """Return what a site sends at the start, by link."""
    x, u, _ = start_values(site, parameters)
    sent = {}
    for sending in site.kind.sends:
        if not sending.send.is_a("SXFunction"):
            rounded = sending.send(*([float(value) for value in part] for part in (x, u, parameters, [0.0])))
            sent[sending.link] = [number(float(value)) for value in np.asarray(rounded).ravel()]
            continue
        symbols = sending.send.sx_in()
        dense = casadi.Function("send", symbols, [casadi.densify(sending.send(*symbols))])
        sent[sending.link] = evaluate_exact(dense, [x, u, parameters, [number(0.0)]], number=number)[0]
    return sent


def _channels_of(site: SiteJacobians) -> list[tuple[tuple[int, ...], ...]]:
    """Return the channels each partition's receives depend on."""
    return [tick.channels for tick in site.pattern.ticks]


def entrywise(site: LinearSite, change: Callable[[Any], Any], kind_of_number: type = object) -> LinearSite:
    """Return the site with every entry changed, in arrays of another kind of number."""
    channels = [tick.channels for tick in site.ticks]
    changed = []
    for matrix in _matrices(site):
        entries: Matrix = np.empty(matrix.size, dtype=kind_of_number)
        entries[:] = [change(value) for value in matrix.ravel()]
        changed.append(entries.reshape(matrix.shape))
    return _assemble(site.kind, site.affine, changed, channels)


def rational_floats(site: LinearSite) -> LinearSite:
    """Return the site with every float as the rational it is."""
    return entrywise(site, Fraction)


def magnitudes(site: LinearSite) -> LinearSite:
    """Return the site with every entry replaced by its absolute value, a leading axis or none."""
    return every_matrix(site, np.abs)


def every_matrix(site: LinearSite, change: Callable[[Matrix], Matrix]) -> LinearSite:
    """Return the site with every matrix changed, a leading axis or none."""
    channels = [tick.channels for tick in site.ticks]
    return _assemble(site.kind, site.affine, [change(matrix) for matrix in _matrices(site)], channels)


def _matrices(site: LinearSite) -> list[Matrix]:
    """List a site's matrices in the order `jacobians` writes them."""
    listed = [site.a, site.b]
    for tick in site.ticks:
        listed += [tick.x, tick.u, tick.m, tick.r]
    for send in site.sends:
        listed += [send.x, send.u]
    return listed


def _assemble(
    kind: Kind,
    affine: bool,
    matrices: Sequence[Matrix],
    channels: Sequence[tuple[tuple[int, ...], ...]],
) -> LinearSite:
    """Put a list of matrices, in the order of `_matrices`, into a site."""
    rest = iter(matrices)
    a, b = next(rest), next(rest)
    ticks = tuple(
        LinearTick(partition.clock, next(rest), next(rest), next(rest), next(rest), heard)
        for partition, heard in zip(kind.clocks, channels, strict=True)
    )
    sends = tuple(LinearSend(sending.link, next(rest), next(rest)) for sending in kind.sends)
    return LinearSite(kind, affine, a, b, ticks, sends)


def _cut(flat: Matrix, shapes: Sequence[tuple[int, int]]) -> list[Matrix]:
    """Cut a row of numbers into column-major matrices."""
    matrices, start = [], 0
    for rows, columns in shapes:
        matrices.append(flat[start : start + rows * columns].reshape((rows, columns), order="F"))
        start += rows * columns
    return matrices


def _pattern(block: Any) -> Matrix:
    """Return the structural nonzeros of a CasADi matrix as truth values."""
    pattern = np.zeros((block.size1(), block.size2()), dtype=bool)
    rows, columns = block.sparsity().get_triplet()
    pattern[rows, columns] = True
    return pattern


def _start(
    site: SiteJacobians,
    parameters: list[Any],
    number: Callable[[float], Any],
    listening: Listening | None,
) -> list[list[Any]]:
    """Return (x, u, m, r, p, t) at the start: holds put out zero.

    The Jacobians of an affine site look at nothing but the parameters: zeros will do.
    """
    kind, zero = site.kind, number(0.0)
    if site.affine:
        sizes = [site.function.numel_in(argument) for argument in range(4)]
        x, u, m, r = ([zero] * size for size in sizes)
        return [x, u, m, r, parameters, [zero]]
    x, u, memories = start_values(site, parameters)
    m = [value for one in memories for value in one]
    if listening is not None:
        r = [number(value) for value in listening.values]  # type: ignore[arg-type] # Fraction and float take both
        return [x, u, m, r, parameters, [zero]]
    place = {name: index for index, name in enumerate(kind.parameters)}
    sent = start_sends(site, parameters, number)
    others = parameters[place[PEERS]] - 1 if PEERS in place else number(1.0)
    r = [
        sent[heard.link][heard.channel] * (others if heard.operator == "sum" else number(1.0))
        for partition in kind.clocks
        for heard in partition.receives
    ]
    return [x, u, m, r, parameters, [zero]]
