"""The linear equations of one site.

Takes: a kind of a `CompiledSystem` and its parameter vector.
Gives: `SiteJacobians` (built once a kind), `LinearSite` (one a parameter vector), `jacobians`, `linearize`,
`linearize_exact`.
Guarantees: structural patterns come from CasADi, whatever the numbers; every matrix says what its rows and
columns are.
Does not: decide when anything happens (see `schedule`), or keep offsets: constant forces move the
equilibrium, not the spectrum.

    dx/dt = A x + B u          continuous
    y     = X x + U u + M m + R r    at a tick of a clock
    s     = X x + U u          at a tick of a link's clock
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import PEERS, Kind
from apc.runtime.exact import evaluate_exact

Matrix = NDArray[Any]


@dataclass(frozen=True, slots=True)
class LinearTick:
    """What a clock partition computes: rows are its outputs; columns states, holds, memories, receives."""

    clock: str
    x: Matrix  # (n_y, n_x)
    u: Matrix  # (n_y, n_u)
    m: Matrix  # (n_y, n_m)
    r: Matrix  # (n_y, n_r)


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
class SiteJacobians:
    """The Jacobians of a kind as one CasADi function of (x, u, m, r, p, t); m and r of all clocks in a row.

    The function's one output is every matrix of a `LinearSite`, in order, column-major; `shapes` cuts it.
    """

    kind: Kind
    function: Any  # casadi.Function
    shapes: tuple[tuple[int, int], ...]
    pattern: LinearSite
    affine: bool


def jacobians(kind: Kind) -> SiteJacobians:
    """Build a kind's Jacobian functions; do it once and keep the result, `linearize` is then cheap."""
    symbol = casadi.SX.sym
    x, u = symbol("x", len(kind.states)), symbol("u", len(kind.holds))
    p, t = symbol("p", len(kind.parameters)), symbol("t")
    memories = [symbol("m", len(partition.memories)) for partition in kind.clocks]
    heard = [symbol("r", len(partition.receives)) for partition in kind.clocks]

    derivative = kind.derivative(x, u, p, t)
    blocks = [casadi.jacobian(derivative, x), casadi.jacobian(derivative, u)]
    for partition, m, r in zip(kind.clocks, memories, heard, strict=True):
        outputs = partition.tick(x, u, m, r, p, t)
        blocks += [casadi.jacobian(outputs, of) for of in (x, u, m, r)]
    for sending in kind.sends:
        sent = sending.send(x, u, p, t)
        blocks += [casadi.jacobian(sent, of) for of in (x, u)]

    m_all, r_all = casadi.vertcat(*memories), casadi.vertcat(*heard)
    flat = casadi.vertcat(*(casadi.vec(casadi.densify(block)) for block in blocks))
    moving = casadi.vertcat(x, u, m_all, r_all, t)
    affine = not (flat.numel() and casadi.depends_on(flat, moving))
    patterns = [_pattern(block) for block in blocks]
    return SiteJacobians(
        kind=kind,
        function=casadi.Function("jacobians", [x, u, m_all, r_all, p, t], [flat]),
        shapes=tuple((int(block.size1()), int(block.size2())) for block in blocks),
        pattern=_assemble(kind, affine, patterns),
        affine=affine,
    )


def linearize(site: SiteJacobians, parameters: NDArray[np.float64]) -> LinearSite:
    """Return the matrices of a site for a parameter vector (n_p,), in the order of `Kind.parameters`."""
    arguments = _start(site, [float(value) for value in parameters], float)
    flat = np.asarray(site.function(*arguments), dtype=np.float64).ravel()
    return _assemble(site.kind, site.affine, _cut(flat, site.shapes))


def linearize_exact(site: SiteJacobians, parameters: NDArray[np.float64]) -> LinearSite:
    """Return the same matrices in exact rationals, as object arrays of `Fraction`."""
    arguments = _start(site, [Fraction(float(value)) for value in parameters], Fraction)
    flat = np.array(evaluate_exact(site.function, arguments)[0], dtype=object)
    return _assemble(site.kind, site.affine, _cut(flat, site.shapes))


def same_dynamics(one: LinearSite, other: LinearSite) -> bool:
    """Say whether two sites of one kind have equal matrices, so that their peers move alike."""
    return one.kind is other.kind and all(
        np.array_equal(mine, yours) for mine, yours in zip(_matrices(one), _matrices(other), strict=True)
    )


def magnitudes(site: LinearSite) -> LinearSite:
    """Return the site with every entry replaced by its absolute value."""
    return _assemble(site.kind, site.affine, [np.abs(matrix) for matrix in _matrices(site)])


def _matrices(site: LinearSite) -> list[Matrix]:
    """List a site's matrices in the order `jacobians` writes them."""
    listed = [site.a, site.b]
    for tick in site.ticks:
        listed += [tick.x, tick.u, tick.m, tick.r]
    for send in site.sends:
        listed += [send.x, send.u]
    return listed


def _assemble(kind: Kind, affine: bool, matrices: Sequence[Matrix]) -> LinearSite:
    """Put a list of matrices, in the order of `_matrices`, into a site."""
    rest = iter(matrices)
    a, b = next(rest), next(rest)
    ticks = tuple(
        LinearTick(partition.clock, next(rest), next(rest), next(rest), next(rest))
        for partition in kind.clocks
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


def _start(site: SiteJacobians, parameters: list[Any], number: Callable[[float], Any]) -> list[list[Any]]:
    """Return (x, u, m, r, p, t) at the start: holds put out zero, the others stand where this site stands.

    The Jacobians of an affine site look at nothing but the parameters: zeros will do.
    """
    kind, zero = site.kind, number(0.0)
    u = [zero] * len(kind.holds)
    if site.affine:
        sizes = [site.function.numel_in(argument) for argument in (0, 2, 3)]
        x, m, r = ([zero] * size for size in sizes)
        return [x, u, m, r, parameters, [zero]]
    place = {name: index for index, name in enumerate(kind.parameters)}

    def named(names: Sequence[str]) -> list[Any]:
        return [parameters[place[name]] for name in names]

    x = named([state.start for state in kind.states])
    m = named([start for partition in kind.clocks for start in partition.starts])
    sent = {}
    for sending in kind.sends:
        symbols = sending.send.sx_in()
        dense = casadi.Function("send", symbols, [casadi.densify(sending.send(*symbols))])
        sent[sending.link] = evaluate_exact(dense, [x, u, parameters, [zero]], number=number)[0]
    others = parameters[place[PEERS]] - 1 if PEERS in place else number(1.0)
    r = [
        sent[heard.link][heard.channel] * (others if heard.operator == "sum" else number(1.0))
        for partition in kind.clocks
        for heard in partition.receives
    ]
    return [x, u, m, r, parameters, [zero]]
