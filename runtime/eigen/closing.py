"""Close a loop: what each site hears is what the others send, and one matrix moves them all.

Takes: a `Loop`.
Gives: `ClosedSystem`, `close_loop`.
Guarantees: the matrix comes with a bound on its rounding error, entry by entry.
Does not: compute eigenvalues (see `spectrum`).

    r_g = Σ_h W_gh s_h        each packet as old as its receiver finds it
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.eigen.graph_modes import Surd
from apc.eigen.loop import Coupling, Loop, Packet, StateLayout, lay_out
from apc.eigen.peer_group import PeerGroup
from apc.frame.discretize import UNIT
from apc.frame.schedule import Way

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ClosedSystem:
    """One autonomous system: state⁺ = `matrix` · state, once a frame.

    The state holds, site by site, z and then the packets on their way; `names` names it, `offsets` says
    where each site's part starts, `packets` lists the packets in order of state (site by site). `error`
    bounds the rounding error of the matrix entry by entry. `heard` is what each site hears in a frame, over
    the state; `motion` says where the continuous states are in the state (site by site). `doubts` say by how
    much each weight of a way may be off; `surds`, of a system of one site, what its weights are in closed
    form.
    """

    name: str
    multiplicity: int
    sites: tuple[PeerGroup, ...]
    coupling: Coupling
    frame_s: float
    names: tuple[str, ...]
    offsets: tuple[int, ...]
    packets: tuple[Packet, ...]
    matrix: Floats  # (n, n)
    error: Floats  # (n, n)
    heard: tuple[Floats, ...]  # (n_r, n), one a site
    motion: tuple[int, ...]
    doubts: Mapping[Way, float] = field(default_factory=dict)
    surds: Mapping[Way, Surd] = field(default_factory=dict)


def close_loop(loop: Loop) -> ClosedSystem:
    """Let K sites hear each other: r_g = Σ_h W_gh s_h, each packet as old as its receiver finds it.

    Notes
    -----
    Packets heard in the frame they are sent in make a loop within the frame, s = S z + D r and r = W₀ s + …,
    that time orders: D W₀ is nilpotent, and I − D W₀ is solved exactly by as many steps as there are packets.
    """
    lifted = [group.lifted for group in loop.sites]
    layout = lay_out(loop)
    exact = [site.blocks for site in lifted]
    matrix, heard = _closed(exact, _links(loop, layout, lambda weight, _: float(weight)), layout)
    motion = [
        offset + place
        for site, offset in zip(lifted, layout.offsets, strict=True)
        for place in range(site.continuous)
    ]
    return ClosedSystem(
        name=loop.name,
        multiplicity=loop.multiplicity,
        sites=loop.sites,
        coupling=loop.coupling,
        frame_s=lifted[0].frame_s,
        names=layout.names,
        offsets=layout.offsets,
        packets=layout.packets,
        matrix=matrix,
        error=_closing_errors(loop, layout),
        heard=tuple(heard),
        motion=tuple(motion),
        doubts=loop.doubts,
        surds=loop.surds,
    )


def _closing_errors(loop: Loop, layout: StateLayout) -> Floats:
    """Return bounds on the errors of a closed matrix, entry by entry: its sites', its weights' and rounding.

    The magnitudes, and the magnitudes with their errors: the difference bounds the error to all orders.
    """
    lifted = [group.lifted for group in loop.sites]
    sizes = [site.mapped(np.abs) for site in lifted]
    large = [one.blocks for one in sizes]
    wide = [one.mapped(np.add, site.error).blocks for one, site in zip(sizes, lifted, strict=True)]
    weights = _links(loop, layout, lambda weight, _: float(abs(weight)))
    doubtful = (
        _links(loop, layout, lambda weight, doubt: float(abs(weight)) + doubt) if loop.doubts else weights
    )
    bound, _ = _closed(large, weights, layout)
    upper, _ = _closed(wide, doubtful, layout)
    # A sum rounds as often as it has terms that are not zero, whatever the size of the whole.
    listened = max(len(group.schedule.heard) for group in loop.sites)
    senders = max((int(np.count_nonzero(now, axis=1).max(initial=0)) for now, _ in weights), default=0)
    terms = max(len(site.z_names) for site in lifted) + listened * (1 + senders)
    roundings = 4 * (terms + 2) * (1 + len(loop.sites[0].schedule.sent)) * UNIT
    return (upper - bound) + roundings * upper


def _links(
    loop: Loop, layout: StateLayout, weigh: Callable[[Fraction, float], float]
) -> list[tuple[Floats, Floats]]:
    """Return, for each site, r over the packets sent this frame and over the state.

    `weigh` makes a number of a weight and by how much it may be off.
    """
    row_of = [{one: row for row, one in enumerate(group.schedule.sent)} for group in loop.sites]
    starts = np.cumsum([0] + [len(group.lifted.s) for group in loop.sites])
    found = []
    for g, group in enumerate(loop.sites):
        now = np.zeros((len(group.schedule.heard), starts[-1]))
        before = np.zeros((len(group.schedule.heard), len(layout.names)))
        for line, one in enumerate(group.schedule.heard):
            doubt = loop.doubts.get(one.way, 0.0)
            for h, weight in enumerate(loop.coupling[one.way][g]):
                if weight == 0 and doubt == 0:
                    continue
                row = row_of[h][one.sent]
                if one.lag == 0:
                    now[line, starts[h] + row] = weigh(weight, doubt)
                else:
                    before[line, layout.places[Packet(h, row, one.lag)]] = weigh(weight, doubt)
        found.append((now, before))
    return found


def _closed(
    blocks: Sequence[Sequence[Floats]], links: Sequence[tuple[Floats, Floats]], layout: StateLayout
) -> tuple[Floats, list[Floats]]:
    """Return the closed matrix and what each site hears, over the state."""
    n = len(layout.names)
    send_state, send_now = [], []
    for (p, _, s, d), (now, before), offset in zip(blocks, links, layout.offsets, strict=True):
        row = np.zeros((len(s), n))
        row[:, offset : offset + len(p)] = s
        send_state.append(row + d @ before)
        send_now.append(d @ now)
    source, within = np.vstack(send_state), np.vstack(send_now)
    sent, term = source, within @ source
    for _ in range(len(within)):
        if not term.any():
            break
        sent, term = sent + term, within @ term
    assert not term.any(), "a packet is heard before it is sent"

    matrix = np.zeros((n, n))
    heard = []
    for (p, q, _, _), (now, before), offset in zip(blocks, links, layout.offsets, strict=True):
        r = now @ sent + before
        heard.append(r)
        rows = slice(offset, offset + len(p))
        matrix[rows, rows] += p
        matrix[rows] += q @ r
    starts = np.cumsum([0] + [len(s) for _, _, s, _ in blocks])
    for packet, place in layout.places.items():
        if packet.lag == 1:
            matrix[place] = sent[starts[packet.site] + packet.row]
        else:
            matrix[place, layout.places[Packet(packet.site, packet.row, packet.lag - 1)]] = 1.0
    return matrix, heard
