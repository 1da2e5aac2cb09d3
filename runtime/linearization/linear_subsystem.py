"""The linear equations of one subsystem as matrices, and operations on all of them.

Takes: a peer type, and matrices of floats, exact rationals, truth values or any other number type.
Gives: `LinearSubsystem`, `LinearTick`, `LinearSend`; `matrices_of`, `assemble`, `cut`; `every_matrix`,
`entrywise`, `rational_floats`, `with_local_parts`.
Guarantees: the rows and columns of every matrix are the same for every number type.
Does not: compute entries (see `linearize`); keep offsets: constant forces move the equilibrium, not the
spectrum.

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
    """The matrices of a clock partition: rows are outputs; columns states, holds, memories, receives.

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
    """The matrices of a send: rows are the channels of a link; columns states and holds."""

    link: str
    x: Matrix  # (n_c, n_x)
    u: Matrix  # (n_c, n_u)


@dataclass(frozen=True, slots=True, eq=False)
class LinearSubsystem:
    """The matrices of one subsystem, in floats, exact rationals, or truth values (a structural pattern).

    `affine` states that the subsystem's equations are affine, so that the matrices are constant; otherwise
    they are the Jacobians at the start values.
    """

    peer_type: PeerType
    affine: bool
    a: Matrix  # (n_x, n_x)
    b: Matrix  # (n_x, n_u)
    ticks: tuple[LinearTick, ...]  # in the order of PeerType.clocks
    sends: tuple[LinearSend, ...]  # in the order of PeerType.sends


def matrices_of(subsystem: LinearSubsystem) -> list[Matrix]:
    """Return a subsystem's matrices in the order in which `jacobians` writes them."""
    listed = [subsystem.a, subsystem.b]
    for tick in subsystem.ticks:
        listed += [tick.x, tick.u, tick.m, tick.r]
    for send in subsystem.sends:
        listed += [send.x, send.u]
    return listed


def assemble(
    peer_type: PeerType,
    affine: bool,
    matrices: Sequence[Matrix],
    channels: Sequence[tuple[tuple[int, ...], ...]],
) -> LinearSubsystem:
    """Return a subsystem from its matrices.

    Parameters
    ----------
    peer_type, affine
        The peer type, and whether its equations are affine.
    matrices
        The matrices in the order of `matrices_of`.
    channels
        The rows of the link's channels of each receive, by clock partition (see `LinearTick`).
    """
    remaining = iter(matrices)
    a, b = next(remaining), next(remaining)
    ticks = tuple(
        LinearTick(
            partition.clock, next(remaining), next(remaining), next(remaining), next(remaining), received
        )
        for partition, received in zip(peer_type.clocks, channels, strict=True)
    )
    sends = tuple(LinearSend(sending.link, next(remaining), next(remaining)) for sending in peer_type.sends)
    return LinearSubsystem(peer_type, affine, a, b, ticks, sends)


def cut(flat: Matrix, shapes: Sequence[tuple[int, int]]) -> list[Matrix]:
    """Return matrices of the given shapes from a row of numbers, or from many rows (k, …), stored column by
    column.
    """
    matrices, start = [], 0
    for rows, columns in shapes:
        block = flat[..., start : start + rows * columns].reshape(*flat.shape[:-1], columns, rows)
        matrices.append(np.ascontiguousarray(block.swapaxes(-1, -2)))
        start += rows * columns
    return matrices


def every_matrix(subsystem: LinearSubsystem, change: Callable[[Matrix], Matrix]) -> LinearSubsystem:
    """Return the subsystem with a function applied to every matrix; matrices may have a leading axis (k)."""
    channels = [tick.channels for tick in subsystem.ticks]
    return assemble(
        subsystem.peer_type, subsystem.affine, [change(matrix) for matrix in matrices_of(subsystem)], channels
    )


def entrywise(
    subsystem: LinearSubsystem, change: Callable[[Any], Any], number_type: type = object
) -> LinearSubsystem:
    """Return the subsystem with a function applied to every entry, in arrays of another number type."""
    channels = [tick.channels for tick in subsystem.ticks]
    changed = []
    for matrix in matrices_of(subsystem):
        entries: Matrix = np.empty(matrix.size, dtype=number_type)
        entries[:] = [change(value) for value in matrix.ravel()]
        changed.append(entries.reshape(matrix.shape))
    return assemble(subsystem.peer_type, subsystem.affine, changed, channels)


def rational_floats(subsystem: LinearSubsystem) -> LinearSubsystem:
    """Return the subsystem with every float converted to the equal `Fraction`."""
    return entrywise(subsystem, Fraction)


def with_local_parts(
    subsystem: LinearSubsystem,
    receive_slopes: Sequence[Sequence[Matrix | None]],
    add: Callable[[Matrix, Matrix], Matrix],
    multiply: Callable[[Matrix, Matrix], Matrix],
) -> LinearSubsystem:
    """Return the subsystem with the slopes of each receive over (x, u, m) added to its ticks.

    Parameters
    ----------
    subsystem
        The subsystem, in any number type.
    receive_slopes
        The slopes (n_x + n_u + n_m,) of each receive of each tick, None for a plain sum or mean.
    add, multiply
        The sum of two matrices, and the outer product of a column and a row.
    """
    ticks = []
    for tick, slopes in zip(subsystem.ticks, receive_slopes, strict=True):
        x, u, m = tick.x, tick.u, tick.m
        n_x, n_u = x.shape[1], u.shape[1]
        for index, row in enumerate(slopes):
            if row is not None:
                column = tick.r[:, index]
                x = add(x, multiply(column, row[:n_x]))
                u = add(u, multiply(column, row[n_x : n_x + n_u]))
                m = add(m, multiply(column, row[n_x + n_u :]))
        ticks.append(replace(tick, x=x, u=u, m=m))
    return replace(subsystem, ticks=tuple(ticks))
