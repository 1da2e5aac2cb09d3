"""Populations by a small determinant: all different on a complete graph, or delays of any length.

Takes: populations of different peers on complete graphs; or a few sites that hear each other.
Gives: `TransferMember`; `of_populations`, `of_loop`.
Guarantees: the determinant's size is what is sent in a frame, by one peer of each role or by the few sites,
whatever the number of peers or the length of a delay.
Does not: find its zeros (see `zeros`).

A peer on a complete graph hears r_i = c_i L(ζ) (σ − s_i), with σ the sum of what all send and L the delays:
hearing −c_i of itself makes it a site T_i, s_i = T_i L σ, and det(I − Σ_i T_i L) = 0. Sites that hear each
other by weights, r_g = Σ_h W_gh ζ^(−lag) s_h, are det(I − T W) = 0, T = diag(T_g): no state for a packet.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial

import numpy as np
from numpy.typing import NDArray

from apc.eigen.closing import Coupling, bounded_weight
from apc.eigen.peers import PeerClass
from apc.frame.exchange import CommunicationGraph, check_mean
from apc.frame.schedule import CouplingTerm, ReceivedSample, Schedule, SentSample
from apc.frame.site import LinearSubsystem
from apc.large.characteristic import Characteristic, characteristic_of
from apc.large.populations import HeterogeneousGroup, hear_themselves
from apc.large.transfer import TransferSubsystems, transfer_of

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TransferMember:
    """The peers of a population, or one site of a loop, as they hear: r = `own` of themselves + `others` τ.

    `sites` have their maps without what they hear of themselves; τ is what is sent to `lines` by all, own
    packets included. A line weighs all that others send by `alike` together. `site` gives one's matrices.
    """

    name: str
    schedule: Schedule
    z_names: tuple[str, ...]
    sites: TransferSubsystems
    own: Floats  # (n_r,)
    others: Floats
    alike: Floats
    site: Callable[[int], LinearSubsystem]


def _weights(
    population: HeterogeneousGroup, populations: Sequence[HeterogeneousGroup], exchange: CommunicationGraph
) -> tuple[Floats, Floats]:
    """Return what each line of r weighs another's packet by on a complete graph, and how many others send.

    Raises
    ------
    ApcError
        E801 a mean over nobody.
    """
    weights, senders = np.ones((2, len(population.schedule.heard)))
    for line, heard in enumerate(population.schedule.heard):
        link = heard.way.link
        senders[line] = sum(other.counts.sum() for other in populations if other.sends(link))
        senders[line] -= population.sends(link)
        if heard.way.operator == "mean":
            first, others = int(exchange.starts[population.group]), float(senders[line])
            check_mean(exchange, first, link, "mean", others > 0, Fraction(others))
            weights[line] = 1.0 / others
    return weights, senders


def of_populations(
    populations: Sequence[HeterogeneousGroup], exchange: CommunicationGraph
) -> tuple[Characteristic, tuple[TransferMember, ...]]:
    """Return the characteristic function of different peers on complete graphs.

    Parameters
    ----------
    populations
        All peers.
    exchange
        The links, all of them complete.
    """
    roles = [exchange.role(population.group) for population in populations]
    sent_place: dict[tuple[int, SentSample], int] = {}
    heard_place: dict[tuple[int, ReceivedSample], int] = {}
    group_of: dict[int, int] = {}
    for role, population in zip(roles, populations, strict=True):
        group_of.setdefault(role, population.group)
        for sent in population.schedule.sent:
            sent_place.setdefault((role, sent), len(sent_place))
        for heard in population.schedule.heard:
            heard_place.setdefault((role, heard), len(heard_place))

    def on_the_way(way: CouplingTerm, sender: int, receiver: int) -> bool:
        return exchange.delay(way.link, group_of[sender], group_of[receiver]) == way.delay

    members, sites = [], []
    for role, population in zip(roles, populations, strict=True):
        schedule = population.schedule
        weight, senders = _weights(population, populations, exchange)
        rows = np.array([sent_place[role, sent] for sent in schedule.sent], np.int64)
        lines = np.array([heard_place[role, heard] for heard in schedule.heard], np.int64)
        own = -weight * np.array([float(on_the_way(heard.way, role, role)) for heard in schedule.heard])
        alone = TransferSubsystems(population.maps, population.counts, rows, lines)
        names = (*(state.name for state in population.jacobians.kind.states), *schedule.value_names)
        members.append(
            TransferMember(
                *(population.name, schedule, names, alone, own, weight, weight * senders, population.site),
            )
        )
        sites.append(replace(alone, maps=hear_themselves(population.maps, schedule, own, weight)))
    lags = sorted({heard.lag for _, heard in heard_place})
    weights = np.zeros((len(lags), len(heard_place), len(sent_place)))
    for (receiver, heard), line in heard_place.items():
        for (sender, sent), row in sent_place.items():
            if sent == heard.sent and on_the_way(heard.way, sender, receiver):
                weights[lags.index(heard.lag), line, row] = 1.0
    transfer = transfer_of(sites, len(sent_place), len(heard_place))
    return characteristic_of(transfer, lags, weights, np.zeros_like(weights)), tuple(members)


def of_loop(
    groups: Sequence[PeerClass], coupling: Coupling, doubts: Mapping[CouplingTerm, float]
) -> tuple[Characteristic, tuple[TransferMember, ...]]:
    """Return the characteristic function of a few sites that hear each other, delays of any length.

    Parameters
    ----------
    groups
        The K sites.
    coupling
        What each hears of each, W (K, K) by way.
    doubts
        By how much each entry of a way's W may be off, where it isn't exact.
    """
    n_s = n_r = 0
    members = []
    for group in groups:
        schedule, maps = group.schedule, group.lifted.mapped(lambda block: block[None])
        rows, lines = np.arange(n_s, n_s + len(schedule.sent)), np.arange(n_r, n_r + len(schedule.heard))
        n_s, n_r = n_s + len(rows), n_r + len(lines)
        sites, unit = TransferSubsystems(maps, np.ones(1), rows, lines), np.ones(len(lines))
        members.append(
            TransferMember(
                *(group.name, schedule, group.z_names, sites, 0 * unit, unit, unit),
                site=partial(_site_of, group),
            )
        )
    transfer = transfer_of([member.sites for member in members], n_s, n_r)
    return characteristic_of(transfer, *_wires_of(groups, coupling, doubts)), tuple(members)


def _site_of(group: PeerClass, _: int) -> LinearSubsystem:
    return group.site


def _wires_of(
    sites: Sequence[PeerClass], coupling: Coupling, doubts: Mapping[CouplingTerm, float]
) -> tuple[tuple[int, ...], Floats, Floats]:
    """Return how what the sites of a loop send comes back to them, r = Σ_l W_l ζ^(−l) s.

    Parameters
    ----------
    sites
        The K sites.
    coupling
        What each hears of each, W (K, K) by way.
    doubts
        By how much each entry of a way's W may be off, where it isn't exact.

    Returns
    -------
    The lags l, the weights W_l (l, n_r, n_s), and what these may be off by.
    """
    sent_starts = np.cumsum([0, *(len(group.schedule.sent) for group in sites)])
    heard_starts = np.cumsum([0, *(len(group.schedule.heard) for group in sites)])
    lags = sorted({heard.lag for group in sites for heard in group.schedule.heard})
    weights = np.zeros((2, len(lags), int(heard_starts[-1]), int(sent_starts[-1])))
    for g, group in enumerate(sites):
        for line, heard in enumerate(group.schedule.heard):
            for h, sender in enumerate(sites):
                if heard.sent in sender.schedule.sent:
                    row = sent_starts[h] + sender.schedule.sent.index(heard.sent)
                    pair = bounded_weight(coupling[heard.way][g][h], doubts.get(heard.way, 0.0))
                    weights[:, lags.index(heard.lag), heard_starts[g] + line, row] = pair
    return tuple(lags), *weights
