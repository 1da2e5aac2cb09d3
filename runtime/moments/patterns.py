"""Second moments of a few peers, pattern by pattern of which packets are lost: bursts, and what stands in.

Takes: a scene of few channels, of each of which one packet a frame may be lost.
Gives: `Patterns`, `held_patterns`, `stand_in_patterns`; `pattern_radius`, `pattern_error`; `largest`,
`settled`.
Guarantees: exact but for rounding: every pattern of lost packets is looked at.
Does not: bound its rounding; serve jitter.

Of C channels each is good or bad, 2^C patterns s. What moves in a frame whose packets are lost as b says is
A_b; second moments X_s, of the frames that begin in pattern s, move by

    X_s'⁺ = Σ_s P(s → s') Σ_b P(b | s) A_b X_s A_bᵀ
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.eigen.matrix_norms import balance
from apc.eigen.modes import dense_loop
from apc.eigen.relative import Relative, relative, relative_coordinates
from apc.frame.radius import value_of
from apc.moments.copies_apart import Peer, largest_error
from apc.moments.crowd import Hearing, standing_motions
from apc.moments.held import Chance, HeldLoop
from apc.moments.mean_loops import standing_state
from apc.moments.stand_in import receivers_of
from apc.moments.unserved import UnservedError
from apc.network.channel import ChannelLaw
from apc.threads import load_pool

Floats = NDArray[np.float64]

# Channels whose patterns are all looked at: 64 matrices, of three peers.
MOST_CHANNELS = 6

# Up to so many numbers, a map of moments is written out.
FEW = 400

# Of larger ones, how many vectors are looked in, for how many eigenvalues, and how often from the start.
VECTORS, TOGETHER, RESTARTED = 60, 4, (40, 1000)

# What is left of a system of equations that is solved in as many vectors, relatively, and how often it starts
# again.
LEFT, RESTARTS = 1e-13, 40

# What the frame of a motion that stands still may be off by, in floats.
STANDING = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Patterns:
    """The frame of each pattern of lost packets, over relative coordinates, and the law of each channel.

    `matrices` (2^C, n, n): channel c's packet is lost in those whose bit c is set. `laws` (C,).
    The coordinates are those of `at`, each divided by its `scale` (n,), of states that begin at `offsets`,
    peer by peer.
    """

    matrices: Floats
    laws: tuple[ChannelLaw, ...]
    at: Relative
    offsets: tuple[int, ...]
    scale: Floats


def held_patterns(held: HeldLoop, chances: Sequence[Chance]) -> Patterns:
    """Return the frames of every pattern where receivers hold what they heard last.

    Parameters
    ----------
    held, chances
        Of `held.every_channel`.
    """
    inner = held.relative()
    f, g, s, e = (value_of(matrix) for matrix in (inner.f, inner.g, inner.s, inner.e))
    lost = np.zeros((2 ** len(chances), len(s), 1))
    for gone, bits in zip(lost, _every_pattern(len(chances)), strict=True):
        for chance, bit in zip(chances, bits, strict=True):
            gone[list(chance.ears)] = bit
    laws = tuple(chance.law for chance in chances)
    return _balanced(f + g @ (s + lost * (e - s)), laws, held.at, held.offsets)


def stand_in_patterns(system: CompiledSystem, hearing: Hearing) -> Patterns:
    """Return the frames of every pattern where own values stand in for missing ones.

    Parameters
    ----------
    system, hearing
        As for `stand_in.stand_in`.
    """
    loop = dense_loop(hearing.groups, hearing.exchange)
    receivers, offsets, law = receivers_of(system, hearing, [loop], loop.coupling)
    channels = [
        (h, g) for h, receiver in enumerate(receivers) for g in np.flatnonzero(receiver.heard.any(axis=0))
    ]
    if len(channels) > MOST_CHANNELS:
        what = f"bursts of values that stand in on {len(channels)} ways"
        raise UnservedError(f"{what}: {MOST_CHANNELS} are the most that are followed")
    matrices = np.zeros((2 ** len(channels), offsets[-1], offsets[-1]))
    for matrix, bits in zip(matrices, _every_pattern(len(channels)), strict=True):
        heard = np.zeros((len(receivers),) * 2)
        for (h, g), bit in zip(channels, bits, strict=True):
            heard[h, g] = 1 - bit
        for h, receiver in enumerate(receivers):
            rows = slice(offsets[h], offsets[h + 1])
            node = int(np.argmin(np.abs(receiver.heard - heard[h]).sum(axis=1)))
            varies = receiver.varies[node, 0]
            size = len(varies)
            means = [value_of(share) for share in receiver.shares]
            matrix[rows] = np.concatenate(means, axis=-1) + varies[:, size:]
            matrix[rows, rows] += value_of(receiver.mean) + varies[:, :size] - means[h]
    known = np.stack([matrices[0], np.full_like(matrices[0], STANDING)])
    at = relative_coordinates(standing_state(known, standing_motions(loop), loop, offsets))
    return _balanced(matrices, (law,) * len(channels), at, tuple(offsets))


def _every_pattern(channels: int) -> NDArray[np.int64]:
    """Return all patterns of lost packets (2^C, C)."""
    return (np.arange(2**channels)[:, None] >> np.arange(channels)) & 1


def _balanced(
    matrices: Floats, laws: tuple[ChannelLaw, ...], at: Relative, offsets: tuple[int, ...]
) -> Patterns:
    """Return patterns of frames (2^C, n, n), in coordinates of one size."""
    inner = relative(matrices, at) if len(matrices[0]) > len(at.rest) else matrices
    # Rounding is small beside the largest moment only: of states of one size it is beside all.
    scale = balance(np.abs(inner).max(axis=0))
    return Patterns(inner / scale[:, None] * scale, laws, at, offsets, scale)


def pattern_error(of: Patterns, classes: Sequence[tuple[int, Peer]]) -> float:
    """Return the largest error of copies in m.

    It is right to what an iteration and rounding leave, of which there is no bound.

    Parameters
    ----------
    of
        The frames of all patterns, stable in mean square.
    classes
        What each peer got, as for `errors.moments_error`.
    """
    likely: Floats = np.ones(1)
    for law in of.laws:
        likely = np.asarray(np.kron([1 - law.bad, law.bad], likely))
    drawn = np.zeros(len(of.at.held) + len(of.at.rest))
    for start, (_, peer) in zip(of.offsets, classes, strict=False):
        drawn[start + np.array(peer.drawn, np.intp)] = 1.0
    added = np.multiply.outer(likely, np.diag(drawn[of.at.rest] / of.scale**2))
    step = a_frame_later(of)
    lasting = settled(step, step(added.reshape(-1)))
    moments = (added + lasting.reshape(added.shape)).sum(axis=0) * np.outer(of.scale, of.scale)
    return largest_error(moments, of.at, of.offsets, classes)


def pattern_radius(of: Patterns) -> float:
    """Return the spectral radius of second moments, in floats.

    Parameters
    ----------
    of
        The frames of all patterns.
    """
    k, n = of.matrices.shape[:2]
    return largest(a_frame_later(of), np.broadcast_to(np.eye(n), (k, n, n)).reshape(-1).copy())


def a_frame_later(of: Patterns) -> Callable[[Floats], Floats]:
    """Return what makes of second moments, pattern by pattern in a row (2^C n²,), those of a frame later."""
    k, n = of.matrices.shape[:2]
    laws = of.laws
    sure = all(law.one_minus_h == 1 and law.one_minus_k == 0 for law in laws)
    chances = _chances(laws) if not sure else None

    def step(flat: Floats) -> Floats:
        x = flat.reshape(k, n, n)
        if chances is None:
            moved = of.matrices @ x @ of.matrices.transpose(0, 2, 1)
        else:
            moved = np.zeros_like(x)
            for b in range(k):
                moved += chances[:, b, None, None] * (of.matrices[b] @ x @ of.matrices[b].T)
        moved = (moved + moved.transpose(0, 2, 1)) / 2
        return _changed(moved.reshape((2,) * len(laws) + (n * n,)), laws).reshape(-1)

    return step


def largest(step: Callable[[Floats], Floats], start: Floats) -> float:
    """Return the largest eigenvalue of a map that leaves a cone of moments invariant, in floats.

    Parameters
    ----------
    step
        The map of vectors (n,).
    start
        Moments (n,) inside the cone.

    Notes
    -----
    The eigenvalue is real, and no other is larger in magnitude. A few are asked for: alone, the first that an
    iteration finds may be one near to it. NaN where these don't come out.
    """
    if start.size <= FEW:
        return float(np.linalg.eigvals(np.array([step(column) for column in np.eye(start.size)])).real.max())
    linalg = load_pool("scipy.sparse.linalg")
    operator = linalg.LinearOperator((start.size, start.size), matvec=step, dtype=np.float64)
    for restarts in RESTARTED:
        # Those that have come out where others have not may be any.
        with suppress(linalg.ArpackNoConvergence):
            values = linalg.eigs(
                operator,
                TOGETHER,
                which="LR",
                v0=start,
                ncv=VECTORS,
                maxiter=restarts,
                tol=1e-13,
                return_eigenvectors=False,
            )
            return float(values.real.max())
    return np.nan


def settled(step: Callable[[Floats], Floats], added: Floats) -> Floats:
    """Return the sum of all that `step` makes of what is added once a frame (n,).

    Parameters
    ----------
    step
        The map of vectors (n,), of a spectral radius below 1.
    added
        What is added (n,).
    """
    linalg = load_pool("scipy.sparse.linalg")
    operator = linalg.LinearOperator((added.size,) * 2, matvec=lambda x: x - step(x), dtype=np.float64)
    result, open_end = linalg.gmres(operator, added, rtol=LEFT, atol=0.0, restart=VECTORS, maxiter=RESTARTS)
    if open_end:
        raise UnservedError("its iteration did not come to an end")
    return np.asarray(result)


def _changed(moved: Floats, laws: Sequence[ChannelLaw]) -> Floats:
    """Return what is in each pattern after every channel changed its state by chance."""
    count = len(laws)
    for c, law in enumerate(laws):
        axis = count - 1 - c  # the last axis is that of bit 0
        good, bad = np.take(moved, 0, axis), np.take(moved, 1, axis)
        moved = np.stack([(1 - law.p) * good + law.r * bad, law.p * good + (1 - law.r) * bad], axis)
    return moved


def _chances(laws: Sequence[ChannelLaw]) -> Floats:
    """Return how likely packets are lost as pattern b says in state s (k, k)."""
    result = np.ones((1, 1))
    for law in laws:
        values = np.array([[1 - law.one_minus_k, law.one_minus_k], [1 - law.one_minus_h, law.one_minus_h]])
        result = np.kron(values, result)
    return result
