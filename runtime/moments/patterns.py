"""Second moments of a few peers, pattern by pattern of which packets are lost: bursts, and what stands in.

Takes: a scene of few channels, all of whose packets are due at the same instant of each frame.
Gives: `Patterns`, `patterns`; `pattern_radius`.
Guarantees: exact but for rounding: every pattern of lost packets is looked at.
Does not: bound its rounding; serve jitter, or packets due at different instants.

Of C channels each is good or bad, 2^C patterns s. What moves in a frame whose packets are lost as b says is
A_b; second moments X_s, of the frames that begin in pattern s, move by

    X_s'⁺ = Σ_s P(s → s') Σ_b P(b | s) A_b X_s A_bᵀ
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared
from apc.compiler.compiled import CompiledSystem
from apc.eigen.closing import Feedback, StateLayout, close
from apc.eigen.modes import dense_loop
from apc.eigen.pseudospectrum import balance
from apc.eigen.relative import relative_coordinates
from apc.frame.lift import FrameMap
from apc.frame.radius import RADII, value_of
from apc.moments.crowd import Hearing, hearing, own_value, remembered_of, standing_motions
from apc.moments.mean_loops import Remembered, Route, standing_state, with_memory
from apc.network.channel import ChannelLaw, channel_law
from apc.threads import load_pool

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Channels whose patterns are all looked at: 2^12 matrices.
MOST_CHANNELS = 12


@dataclass(frozen=True, slots=True)
class Patterns:
    """The frame of each pattern of lost packets, over relative coordinates, and the law of each channel.

    `matrices` (2^C, n, n): channel c's packet is lost in those whose bit c is set. `laws` (C,).
    """

    matrices: Floats
    laws: tuple[ChannelLaw, ...]


def patterns(system: CompiledSystem, prepared: Prepared, first: Fraction) -> Patterns:
    """Close the whole scene for every pattern of lost packets.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `analysis.prepare` made of it.
    first
        When frames begin: all packets that may be lost are due then.
    """
    told = hearing(system, prepared, first=first, stand_in=True)
    loop = dense_loop(told.groups, told.exchange)
    remembered = {one.route: one for one in remembered_of(system, told, loop, perfect=True)}
    links = {link.name: link for link in system.links}
    lossy = {
        route: channel_law(system, links[route[0]], told.timings[route[1]])
        for route in remembered
        if links[route[0]].channel is not None
    }
    channels = sorted(
        {
            (way.link, way.delay, g, h)
            for way, rows in loop.coupling.items()
            if (way.link, way.delay) in lossy
            for g, row in enumerate(rows)
            for h, weight in enumerate(row)
            if weight
        }
    )
    sites = [with_memory(group, list(remembered.values())) for group in loop.sites]
    starts = np.cumsum([0] + [one.map.s.shape[-2] for one in sites]).tolist()
    offsets = np.cumsum([0] + [len(one.names) for one in sites]).tolist()
    holding = [one for one in channels if _holds(links[one[0]])]
    firsts: dict[tuple[str, str, int, int], int] = {}
    n = offsets[-1]
    for one in holding:
        firsts[one] = n
        n += len(remembered[one[0], one[1]].channels)
    names = tuple(name for one in sites for name in one.names)
    layout = StateLayout(tuple(offsets[:-1]), (*names, *["held"] * (n - offsets[-1])), {})
    number = {one: place for place, one in enumerate(channels)}
    lost = (np.arange(2 ** len(channels))[:, None] >> np.arange(len(channels))) & 1  # (k, C)
    feedback = []
    for g, rows in enumerate(told.of(loop)):
        now, before = np.zeros((len(lost), len(rows), starts[-1])), np.zeros((len(lost), len(rows), n))
        for line, row in enumerate(rows):
            route = row.way.link, row.way.delay
            one = remembered.get(route)
            if one is None or row.channel not in one.channels:
                continue
            for h, weight in enumerate(loop.coupling[row.way][g]):
                if not weight:
                    continue
                value = starts[h] + sites[h].values[route, row.channel, one.memory.heard[row.clock, row.tick]]
                channel = (*route, g, h)
                if route not in lossy:
                    now[:, line, value] = 0.0 if row.gap else float(weight)
                    continue
                gone = lost[:, number[channel]] * float(weight)
                if row.gap:
                    now[:, line, starts[g] + sites[g].sent[own_value(row)]] += gone
                    continue
                now[:, line, value] = float(weight) - gone
                if channel in firsts:
                    before[:, line, firsts[channel] + one.channels.index(row.channel)] = gone
        feedback.append(Feedback(now, before))
    maps = [FrameMap(*(value_of(block) for block in one.map.blocks)) for one in sites]
    closed = close(maps, feedback, layout)
    matrix = closed.matrix
    sent = closed.sent
    for channel, place in firsts.items():
        one, gone = remembered[channel[0], channel[1]], lost[:, number[channel], None]
        value = one.memory.heard[min(one.memory.heard)]
        for place_of, name in enumerate(one.channels):
            row = sent[:, starts[channel[3]] + sites[channel[3]].values[one.route, name, value]]
            matrix[:, place + place_of] = row * (1 - gone)
            matrix[:, place + place_of, place + place_of] += gone[:, 0]
    basis = _standing(matrix[0], standing_motions(loop), loop, offsets)
    at = relative_coordinates(basis)
    inner = matrix[:, at.rest[:, None], at.rest]
    if len(at.held):
        inner = inner - at.weights @ matrix[:, at.held[:, None], at.rest]
    # Rounding is small beside the largest moment only: of states of one size it is beside all.
    scale = balance(np.abs(inner).max(axis=0))
    inner = inner / scale[:, None] * scale
    return Patterns(inner, tuple(lossy[one[0], one[1]] for one in channels))


def _standing(matrix: Floats, standing: Floats, loop: Any, offsets: Sequence[int]) -> Floats:
    """Return rigid motions over the state, held values included."""
    bounded = RADII.exact(matrix)
    bounded[1] = 1e-12
    return standing_state(bounded, standing, loop, [*offsets[:-1], len(matrix)])


def _holds(link: Any) -> bool:
    return link.channel is not None and link.channel.on_loss == "hold"


def pattern_radius(of: Patterns) -> float:
    """Return the spectral radius of second moments, in floats.

    Parameters
    ----------
    of
        The frames of all patterns.
    """
    k, n = of.matrices.shape[:2]
    count = len(of.laws)
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
        return _changed(moved.reshape((2,) * count + (n * n,)), laws).reshape(-1)

    start = np.broadcast_to(np.eye(n), (k, n, n)).reshape(-1).copy()
    size = k * n * n
    if size <= 400:
        matrix = np.array([step(column) for column in np.eye(size)]).T
        return float(np.abs(np.linalg.eigvals(matrix)).max())
    linalg = load_pool("scipy.sparse.linalg")
    operator = linalg.LinearOperator((size, size), matvec=step, dtype=np.float64)
    values = linalg.eigs(operator, k=1, which="LR", v0=start, return_eigenvectors=False, tol=1e-13, ncv=40)
    return float(np.abs(values).max())


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
