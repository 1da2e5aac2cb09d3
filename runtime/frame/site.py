"""The linear equations of one site as matrices, and what can be done to all of them alike.

Takes: a kind, and matrices of floats, exact rationals, truth values or any other kind of number.
Gives: `LinearSubsystem`, `LinearTick`, `LinearSend`; `matrices_of`, `assemble`, `cut`; `every_matrix`,
`entrywise`, `rational_floats`, `with_own_parts`.
Guarantees: every matrix says what its rows and columns are, whatever kind of number it holds.
Does not: compute a number of them (see `linearize`); keep offsets: constant forces move the equilibrium, not
the spectrum.

    dx/dt = A x + B u          continuous
    y     = X x + U u + M m + R r    at a tick of a clock
    s     = X x + U u          at a tick of a link's clock
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import PeerType

Matrix = NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
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


@dataclass(frozen=True, slots=True, eq=False)
class LinearSend:
    """What a site sends over a link: rows are the channels; columns states and holds."""

    link: str
    x: Matrix  # (n_c, n_x)
    u: Matrix  # (n_c, n_u)


@dataclass(frozen=True, slots=True, eq=False)
class LinearSubsystem:
    """The matrices of one site, in floats, exact rationals, or truth values (a structural pattern).

    `affine` says that the site's own equations are affine, so that the matrices hold everywhere;
    otherwise they are the Jacobians at the start values.
    """

    kind: PeerType
    affine: bool
    a: Matrix  # (n_x, n_x)
    b: Matrix  # (n_x, n_u)
    ticks: tuple[LinearTick, ...]  # in the order of Kind.clocks
    sends: tuple[LinearSend, ...]  # in the order of Kind.sends


def matrices_of(site: LinearSubsystem) -> list[Matrix]:
    """List a site's matrices in the order `jacobians` writes them."""
    listed = [site.a, site.b]
    for tick in site.ticks:
        listed += [tick.x, tick.u, tick.m, tick.r]
    for send in site.sends:
        listed += [send.x, send.u]
    return listed


def assemble(
    kind: PeerType,
    affine: bool,
    matrices: Sequence[Matrix],
    channels: Sequence[tuple[tuple[int, ...], ...]],
) -> LinearSubsystem:
    """Put a list of matrices, in the order of `matrices_of`, into a site."""
    rest = iter(matrices)
    a, b = next(rest), next(rest)
    ticks = tuple(
        LinearTick(partition.clock, next(rest), next(rest), next(rest), next(rest), heard)
        for partition, heard in zip(kind.clocks, channels, strict=True)
    )
    sends = tuple(LinearSend(sending.link, next(rest), next(rest)) for sending in kind.sends)
    return LinearSubsystem(kind, affine, a, b, ticks, sends)


def cut(flat: Matrix, shapes: Sequence[tuple[int, int]]) -> list[Matrix]:
    """Cut a row of numbers, or many (k, …), into matrices that it holds column by column."""
    matrices, start = [], 0
    for rows, columns in shapes:
        block = flat[..., start : start + rows * columns].reshape(*flat.shape[:-1], columns, rows)
        matrices.append(np.ascontiguousarray(block.swapaxes(-1, -2)))
        start += rows * columns
    return matrices


def every_matrix(site: LinearSubsystem, change: Callable[[Matrix], Matrix]) -> LinearSubsystem:
    """Return the site with every matrix changed, a leading axis or none."""
    channels = [tick.channels for tick in site.ticks]
    return assemble(site.kind, site.affine, [change(matrix) for matrix in matrices_of(site)], channels)


def entrywise(
    site: LinearSubsystem, change: Callable[[Any], Any], kind_of_number: type = object
) -> LinearSubsystem:
    """Return the site with every entry changed, in arrays of another kind of number."""
    channels = [tick.channels for tick in site.ticks]
    changed = []
    for matrix in matrices_of(site):
        entries: Matrix = np.empty(matrix.size, dtype=kind_of_number)
        entries[:] = [change(value) for value in matrix.ravel()]
        changed.append(entries.reshape(matrix.shape))
    return assemble(site.kind, site.affine, changed, channels)


def rational_floats(site: LinearSubsystem) -> LinearSubsystem:
    """Return the site with every float as the rational it is."""
    return entrywise(site, Fraction)


def with_own_parts(
    site: LinearSubsystem,
    own: Sequence[Sequence[Matrix | None]],
    add: Callable[[Matrix, Matrix], Matrix],
    multiply: Callable[[Matrix, Matrix], Matrix],
) -> LinearSubsystem:
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
