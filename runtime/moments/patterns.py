"""Second moments of a few peers, pattern by pattern of which packets are lost: bursts, and what stands in.

Takes: a scene of few channels, all of whose packets are due at the same instant of each frame.
Gives: `Frames`, `frames`; `Patterns`, `patterns`; `every_pattern`, `of_all`; `pattern_radius`,
`resting_moments`; `largest`, `settled`.
Guarantees: exact but for rounding: every pattern of lost packets is looked at.
Does not: bound its rounding; serve jitter, or packets due at different instants.

Of C channels each is good or bad, 2^C patterns s. What moves in a frame whose packets are lost as b says is
A_b; second moments X_s, of the frames that begin in pattern s, move by

    X_s'⁺ = Σ_s P(s → s') Σ_b P(b | s) A_b X_s A_bᵀ
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared
from apc.compiler.compiled import CompiledSystem
from apc.eigen.closing import Feedback, StateLayout, close
from apc.eigen.modes import dense_loop
from apc.eigen.pseudospectrum import balance
from apc.eigen.relative import Relative, relative, relative_coordinates
from apc.frame.lift import FrameMap
from apc.frame.radius import RADII, value_of
from apc.moments.crowd import Hearing, hearing, own_value, remembered_of, standing_motions
from apc.moments.mean_loops import standing_state, with_memory
from apc.network.channel import ChannelLaw, channel_law
from apc.threads import load_pool

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Channels whose patterns are all looked at: 64 matrices, of three peers.
MOST_CHANNELS = 6

# Up to so many numbers, a map of moments is written out.
FEW = 400

# Of larger ones, how many vectors are looked in, for how many eigenvalues and how often from the start: first
# a few, and where none is found one alone.
VECTORS, TRIES = 60, ((4, 40), (1, 1000))

# What is left of a system of equations that is solved in as many vectors, relatively, and how often it starts
# again.
LEFT, RESTARTS = 1e-13, 40

# What the frame of a motion that stands still may be off by, in floats.
STANDING = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """The whole scene in frames whose packets are lost as patterns say: `matrices` (k, n, n).

    The state holds each peer's own, then what each of the `channels` (link, delay, receiver, sender) holds,
    from `held` of it on. `basis` (n, d) are the motions that nothing holds back, `laws` those of the
    channels. `sites` (N + 1,) says where each peer's own starts.
    """

    matrices: Floats
    basis: Floats
    channels: tuple[tuple[str, str, int, int], ...]
    held: Mapping[int, range]
    sites: tuple[int, ...]
    laws: tuple[ChannelLaw, ...]


def frames(
    system: CompiledSystem,
    prepared: Prepared,
    first: Fraction,
    lost: Callable[[int], NDArray[np.int64]],
    *,
    told: Hearing | None = None,
) -> Frames:
    """Close the whole scene for some patterns of lost packets.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `analysis.prepare` made of it.
    first
        When frames begin: all packets that may be lost are due then.
    lost
        Gives the patterns (k, C) of C channels: 1 for a packet that is lost.
    told
        Its peers, where they are not those of `hearing` with what stands in.
    """
    told = told or hearing(system, prepared, first=first, stand_in=True)
    loop = dense_loop(told.groups, told.exchange)
    remembered = {one.route: one for one in remembered_of(system, told, loop, perfect=True)}
    links = {link.name: link for link in system.links}
    laws = {
        route: channel_law(system, links[route[0]], told.timings[route[1]])
        for route in remembered
        if links[route[0]].channel is not None
    }
    channels: list[tuple[str, str, int, int]] = sorted(
        {
            (way.link, way.delay, g, h)
            for way, rows in loop.coupling.items()
            if (way.link, way.delay) in laws
            for g, row in enumerate(rows)
            for h, weight in enumerate(row)
            if weight
        }
    )
    sites = [with_memory(group, list(remembered.values())) for group in loop.sites]
    starts = np.cumsum([0] + [one.map.s.shape[-2] for one in sites]).tolist()
    offsets = np.cumsum([0] + [len(one.names) for one in sites]).tolist()
    held: dict[int, range] = {}
    n = offsets[-1]
    for place, (name, delay, *_) in enumerate(channels):
        channel = links[name].channel
        if channel is not None and channel.on_loss == "hold":
            held[place] = range(n, n + len(remembered[name, delay].channels))
            n = held[place].stop
    names = tuple(name for one in sites for name in one.names)
    layout = StateLayout(tuple(offsets[:-1]), (*names, *["held"] * (n - offsets[-1])), {})
    number = {which: place for place, which in enumerate(channels)}
    gone = lost(len(channels))
    feedback = []
    for g, rows in enumerate(told.of(loop)):
        now: Matrix = np.zeros((len(gone), len(rows), starts[-1]))
        before: Matrix = np.zeros((len(gone), len(rows), n))
        for line, row in enumerate(rows):
            route = row.way.link, row.way.delay
            one = remembered.get(route)
            if one is None or row.channel not in one.channels:
                continue
            for h, weight in enumerate(loop.coupling[row.way][g]):
                if not weight:
                    continue
                value = starts[h] + sites[h].values[route, row.channel, one.memory.heard[row.clock, row.tick]]
                if route not in laws:
                    now[:, line, value] = float(weight)
                    continue
                place = number[*route, g, h]
                missed = gone[:, place] * float(weight)
                if row.gap:
                    now[:, line, starts[g] + sites[g].sent[own_value(row)]] += missed
                    continue
                now[:, line, value] = float(weight) - missed
                if place in held:
                    before[:, line, held[place][one.channels.index(row.channel)]] = missed
        feedback.append(Feedback(now, before))
    maps = [FrameMap(*(value_of(block) for block in one.map.blocks)) for one in sites]
    closed = close(maps, feedback, layout)
    matrix = closed.matrix
    for place, states in held.items():
        name, delay, _, h = channels[place]
        of, lost_now = remembered[name, delay], gone[:, place, None]
        value = of.memory.heard[min(of.memory.heard)]
        for state, what in zip(states, of.channels, strict=True):
            arrived = closed.sent[:, starts[h] + sites[h].values[of.route, what, value]]
            matrix[:, state] = arrived * (1 - lost_now)
            matrix[:, state, state] += lost_now[:, 0]
    known = RADII.exact(matrix[0])
    known[1] = STANDING
    basis = standing_state(known, standing_motions(loop), loop, [*offsets[:-1], n])
    return Frames(
        matrix, basis, tuple(channels), held, tuple(offsets), tuple(laws[one[0], one[1]] for one in channels)
    )


@dataclass(frozen=True, slots=True, eq=False)
class Patterns:
    """The frame of each pattern of lost packets, over relative coordinates, and the law of each channel.

    `matrices` (2^C, n, n): channel c's packet is lost in those whose bit c is set. `laws` (C,).
    The coordinates are those of `at`, each divided by its `scale` (n,).
    """

    matrices: Floats
    laws: tuple[ChannelLaw, ...]
    at: Relative
    scale: Floats


def patterns(system: CompiledSystem, prepared: Prepared, first: Fraction) -> Patterns:
    """Close the whole scene for every pattern of lost packets; parameters as for `frames`."""
    return of_all(frames(*(system, prepared, first), every_pattern))


def every_pattern(channels: int) -> NDArray[np.int64]:
    """Return all patterns of lost packets (2^C, C)."""
    return (np.arange(2**channels)[:, None] >> np.arange(channels)) & 1


def of_all(found: Frames) -> Patterns:
    """Return the frames of every pattern over relative coordinates."""
    at = relative_coordinates(found.basis)
    inner = relative(found.matrices, at)
    # Rounding is small beside the largest moment only: of states of one size it is beside all.
    scale = balance(np.abs(inner).max(axis=0))
    return Patterns(inner / scale[:, None] * scale, found.laws, at, scale)


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


def resting_moments(of: Patterns, drawn: Floats) -> Floats | None:
    """Return the second moments (n, n) of a long run in floats, None where they are not found.

    Parameters
    ----------
    of
        The frames of all patterns, stable in mean square.
    drawn
        The covariance (n, n) of what is added at the end of each frame, by chance of its own.
    """
    likely: Floats = np.ones(1)
    for law in of.laws:
        likely = np.asarray(np.kron([1 - law.bad, law.bad], likely))
    scale = np.outer(of.scale, of.scale)
    added = np.multiply.outer(likely, drawn / scale)
    after = a_frame_later(of)(added.reshape(-1)).reshape(added.shape)
    # What is drawn anew is there for a frame: all that lasts is over the other states.
    rest = np.flatnonzero(of.matrices.any(axis=(0, 2)))
    inner = np.ix_(np.arange(len(added)), rest, rest)
    step = a_frame_later(replace(of, matrices=of.matrices[inner]))
    found = settled(step, after[inner].reshape(-1))
    if found is None:
        return None
    added[inner] += found.reshape(after[inner].shape)
    return np.asarray(added.sum(axis=0) * scale)


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
    iteration finds may be one near to it.
    """
    if start.size <= FEW:
        return float(np.linalg.eigvals(np.array([step(column) for column in np.eye(start.size)])).real.max())
    linalg = load_pool("scipy.sparse.linalg")
    operator = linalg.LinearOperator((start.size, start.size), matvec=step, dtype=np.float64)
    found: list[float] = []
    for count, restarts in TRIES:
        try:
            values = linalg.eigs(
                operator,
                count,
                which="LR",
                v0=start,
                ncv=VECTORS,
                maxiter=restarts,
                tol=1e-13,
                return_eigenvectors=False,
            )
        except linalg.ArpackNoConvergence as slow:  # the largest come first
            values = slow.eigenvalues
        found = values.real.tolist()
        if found:
            break
    return max(found, default=np.nan)


def settled(step: Callable[[Floats], Floats], added: Floats) -> Floats | None:
    """Return the sum of all that `step` makes of what is added once a frame (n,), None where it isn't found.

    Parameters
    ----------
    step
        The map of vectors (n,), of a spectral radius below 1.
    added
        What is added (n,).
    """
    linalg = load_pool("scipy.sparse.linalg")
    operator = linalg.LinearOperator((added.size,) * 2, matvec=lambda x: x - step(x), dtype=np.float64)
    found, open_end = linalg.gmres(operator, added, rtol=LEFT, atol=0.0, restart=VECTORS, maxiter=RESTARTS)
    return None if open_end else np.asarray(found)


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
    found = np.ones((1, 1))
    for law in laws:
        one = np.array([[1 - law.one_minus_k, law.one_minus_k], [1 - law.one_minus_h, law.one_minus_h]])
        found = np.kron(one, found)
    return found
