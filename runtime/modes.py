"""Close the loop between peers, as few small systems instead of one large one.

Takes: groups of equal peers, each with its linear site, schedule and lifted site.
Gives: `PeerGroup`, `ClosedSystem`, `close`, `modes`, `dense`.
Guarantees: the systems of `modes`, each as often as its multiplicity says, have together the spectrum of
`dense`, whatever the number of peers; the cost grows with the number of different groups only.
Does not: compute eigenvalues (see `spectrum`).

On a complete graph a peer of group g hears r = c_g (Σ_j s_j − s_own), with c_g = 1/(others) for a mean and 1
for a sum. K groups of n_1 … n_K equal peers then split exactly:

    common        all peers of a group alike: r_g = c_g Σ_h (n_h − δ_gh) s_h        once
    difference g  peers of group g apart, their sum zero, all else at rest: r_g = −c_g s_g        n_g − 1
    times
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.runtime.discretize import UNIT
from apc.runtime.lift import LiftedSite, lift
from apc.runtime.linearize import LinearSite, SiteJacobians, linearize, linearize_exact, same_dynamics
from apc.runtime.schedule import Schedule

Floats = NDArray[np.float64]

# What site g hears of site h: the weight on h's packet, by operator and link.
Coupling = Mapping[tuple[str, str], tuple[tuple[Fraction, ...], ...]]


@dataclass(frozen=True, slots=True)
class PeerGroup:
    """`count` peers that move alike; `parameters` is their vector (n_p,)."""

    name: str
    count: int
    parameters: Floats
    jacobians: SiteJacobians
    site: LinearSite
    schedule: Schedule
    lifted: LiftedSite

    def exact(self) -> LinearSite:
        """The site's matrices in exact rationals."""
        return linearize_exact(self.jacobians, self.parameters)


@dataclass(frozen=True, slots=True)
class Packet:
    """A packet that is still to be heard: row of s of site `site`, sent `lag` frames ago (1 or more)."""

    site: int
    row: int
    lag: int


@dataclass(frozen=True, slots=True)
class ClosedSystem:
    """One autonomous system: state⁺ = `matrix` · state, once a frame.

    The state holds, site by site, z and then the packets on their way; `names` names it, `offsets` says
    where each site's part starts, `packets` lists the packets in order of state (site by site). `error`
    bounds the rounding error of the matrix entry by entry. `inside` holds all continuous states (site by
    site) at the ticks of the fastest clock as rows over the state; `motion` says where these are in the
    state.
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
    inside: Floats  # (marks, n_x of all sites, n)
    motion: tuple[int, ...]


def peer_groups(
    system: CompiledSystem,
    jacobians: Sequence[SiteJacobians],
    schedules: Sequence[Schedule],
    parameters: Sequence[Floats],
) -> tuple[PeerGroup, ...]:
    """Lift every group of a system once; groups of equal dynamics become one, named `left+right`.

    Parameters
    ----------
    system
        The compiled scene.
    jacobians, schedules
        One a kind.
    parameters
        One vector (n_p,) a group.
    """
    groups: list[PeerGroup] = []
    for group, vector in zip(system.groups, parameters, strict=True):
        site = linearize(jacobians[group.kind], vector)
        for place, known in enumerate(groups):
            if same_dynamics(site, known.site):
                groups[place] = replace(
                    known, name=f"{known.name}+{group.name}", count=known.count + group.count
                )
                break
        else:
            schedule = schedules[group.kind]
            groups.append(
                PeerGroup(
                    group.name,
                    group.count,
                    vector,
                    jacobians[group.kind],
                    site,
                    schedule,
                    lift(site, schedule, exact=linearize_exact(jacobians[group.kind], vector)),
                )
            )
    return tuple(groups)


def modes(groups: Sequence[PeerGroup]) -> tuple[ClosedSystem, ...]:
    """Split the whole system into one common system and a difference system a group of two or more."""
    peers = sum(group.count for group in groups)
    name = "single" if peers == 1 else "common"
    systems = [
        close(groups, _coupling(groups, lambda g, h: groups[h].count - (1 if g == h else 0)), name=name)
    ]
    for place, group in enumerate(groups):
        if group.count < 2:
            continue
        weights = _coupling(groups, lambda g, h: -1 if g == h else 0)
        own = {key: ((rows[place][place],),) for key, rows in weights.items()}
        systems.append(
            close(
                [group],
                own,
                name="difference" if len(groups) == 1 else f"difference {group.name}",
                multiplicity=group.count - 1,
            )
        )
    return tuple(systems)


def dense(groups: Sequence[PeerGroup]) -> ClosedSystem:
    """Assemble every peer of the whole system: the check on `modes`, at the cost of N³."""
    everyone = [
        replace(group, name=f"{group.name}[{number + 1}]", count=1)
        for group in groups
        for number in range(group.count)
    ]
    return close(everyone, _coupling(everyone, lambda g, h: 0 if g == h else 1), name="dense")


def _coupling(groups: Sequence[PeerGroup], others: Callable[[int, int], int]) -> Coupling:
    """Weigh `others(g, h)` packets of site h at site g: 1 for a sum, 1/(number of others) for a mean."""
    pairs = sorted({(one.operator, one.sent.link) for group in groups for one in group.schedule.heard})
    coupling = {}
    for operator, link in pairs:
        sends = [any(sending.link == link for sending in group.jacobians.kind.sends) for group in groups]
        total = sum(group.count for group, does in zip(groups, sends, strict=True) if does)
        rows = []
        for g in range(len(groups)):
            number = total - (1 if sends[g] else 0)
            assert number > 0, f"a peer of {groups[g].name} hears {link}, but nobody else sends"
            weight = Fraction(1, number) if operator == "mean" else Fraction(1)
            rows.append(tuple(weight * others(g, h) if sends[h] else Fraction(0) for h in range(len(groups))))
        coupling[operator, link] = tuple(rows)
    return coupling


def close(
    sites: Sequence[PeerGroup], coupling: Coupling, *, name: str, multiplicity: int = 1
) -> ClosedSystem:
    """Let K sites hear each other: r_g = Σ_h W_gh s_h, each packet as old as its receiver finds it.

    Parameters
    ----------
    sites
        The K sites.
    coupling
        W (K, K) by operator and link, exact.
    name, multiplicity
        What the system is called and how often the whole holds it.

    Notes
    -----
    Packets heard in the frame they are sent in make a loop within the frame, s = S z + D r and r = W₀ s + …,
    that time orders: D W₀ is nilpotent, and I − D W₀ is solved exactly by as many steps as there are packets.
    """
    lifted = [group.lifted for group in sites]
    row_of = [{one: row for row, one in enumerate(group.schedule.sent)} for group in sites]
    packets = tuple(
        Packet(h, row, lag)
        for h, group in enumerate(sites)
        for row, depth in enumerate(group.schedule.depths)
        for lag in range(1, depth + 1)
    )
    offsets, names = _layout(sites, packets)
    place_of = _places(sites, packets, offsets)
    n = len(names)
    s_start = np.cumsum([0] + [len(site.s) for site in lifted])

    def links(weigh: Callable[[Fraction], float]) -> list[tuple[Floats, Floats]]:
        """Return, for each site, r over the packets sent this frame and over the state."""
        found = []
        for g, group in enumerate(sites):
            now = np.zeros((len(group.schedule.heard), s_start[-1]))
            before = np.zeros((len(group.schedule.heard), n))
            for line, one in enumerate(group.schedule.heard):
                for h, weight in enumerate(coupling[one.operator, one.sent.link][g]):
                    if weight == 0:
                        continue
                    row = row_of[h][one.sent]
                    if one.lag == 0:
                        now[line, s_start[h] + row] = weigh(weight)
                    else:
                        before[line, place_of[Packet(h, row, one.lag)]] = weigh(weight)
            found.append((now, before))
        return found

    exact = [(site.p, site.q, site.s, site.d) for site in lifted]
    matrix, heard = _closed(exact, links(float), offsets, packets, place_of, n)
    # The magnitudes, and the magnitudes with their errors: the difference bounds the error to all orders.
    large = [tuple(np.abs(block) for block in blocks) for blocks in exact]
    wide = [
        tuple(
            block + error
            for block, error in zip(
                blocks, (site.p_error, site.q_error, site.s_error, site.d_error), strict=True
            )
        )
        for blocks, site in zip(large, lifted, strict=True)
    ]
    weights = links(lambda weight: float(abs(weight)))
    bound, _ = _closed(large, weights, offsets, packets, place_of, n)
    upper, _ = _closed(wide, weights, offsets, packets, place_of, n)
    roundings = 4 * (n + s_start[-1]) * (1 + len(sites[0].schedule.sent)) * UNIT
    error = (upper - bound) + roundings * upper

    marks = min(len(site.inside) for site in lifted)
    inside = np.zeros((marks, sum(site.continuous for site in lifted), n))
    motion: list[int] = []
    for g, site in enumerate(lifted):
        n_z = len(site.z_names)
        rows = slice(len(motion), len(motion) + site.continuous)
        inside[:, rows, offsets[g] : offsets[g] + n_z] = site.inside[:, :, :n_z]
        inside[:, rows] += site.inside[:, :, n_z:] @ heard[g]
        motion += range(offsets[g], offsets[g] + site.continuous)
    return ClosedSystem(
        name=name,
        multiplicity=multiplicity,
        sites=tuple(sites),
        coupling=coupling,
        frame_s=lifted[0].frame_s,
        names=names,
        offsets=offsets,
        packets=packets,
        matrix=matrix,
        error=error,
        inside=inside,
        motion=tuple(motion),
    )


def _closed(
    blocks: Sequence[Sequence[Floats]],
    links: Sequence[tuple[Floats, Floats]],
    offsets: Sequence[int],
    packets: Sequence[Packet],
    place_of: Mapping[Packet, int],
    n: int,
) -> tuple[Floats, list[Floats]]:
    """Return the closed matrix and what each site hears, over the state."""
    send_state, send_now = [], []
    for (p, _, s, d), (now, before), offset in zip(blocks, links, offsets, strict=True):
        row = np.zeros((len(s), n))
        row[:, offset : offset + len(p)] = s
        send_state.append(row + d @ before)
        send_now.append(d @ now)
    source, loop = np.vstack(send_state), np.vstack(send_now)
    sent, term = source, loop @ source
    for _ in range(len(loop)):
        if not term.any():
            break
        sent, term = sent + term, loop @ term
    assert not term.any(), "a packet is heard before it is sent"

    matrix = np.zeros((n, n))
    heard = []
    for (p, q, _, _), (now, before), offset in zip(blocks, links, offsets, strict=True):
        r = now @ sent + before
        heard.append(r)
        rows = slice(offset, offset + len(p))
        matrix[rows, rows] += p
        matrix[rows] += q @ r
    starts = np.cumsum([0] + [len(s) for _, _, s, _ in blocks])
    for packet in packets:
        place = place_of[packet]
        if packet.lag == 1:
            matrix[place] = sent[starts[packet.site] + packet.row]
        else:
            matrix[place, place_of[Packet(packet.site, packet.row, packet.lag - 1)]] = 1.0
    return matrix, heard


def _layout(sites: Sequence[PeerGroup], packets: Sequence[Packet]) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Return where each site's part of the state starts, and the names of the state."""
    offsets: list[int] = []
    names: list[str] = []
    for h, group in enumerate(sites):
        offsets.append(len(names))
        schedule = group.schedule
        own = list(group.lifted.z_names)
        for packet in packets:
            if packet.site == h:
                quanta = schedule.sent_times[packet.row] - packet.lag * schedule.frame
                when = float(quanta * schedule.quantum * 1000)
                own.append(f"{schedule.sent_names[packet.row]}({when:.6g} ms)")
        names += own if len(sites) == 1 else [f"{group.name}.{name}" for name in own]
    return tuple(offsets), tuple(names)


def _places(
    sites: Sequence[PeerGroup], packets: Sequence[Packet], offsets: Sequence[int]
) -> dict[Packet, int]:
    """Return where in the state each packet is."""
    following = [offset + len(group.lifted.z_names) for group, offset in zip(sites, offsets, strict=True)]
    places = {}
    for packet in packets:
        places[packet] = following[packet.site]
        following[packet.site] += 1
    return places
