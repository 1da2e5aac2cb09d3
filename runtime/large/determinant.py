"""Populations by a small determinant: all different on a complete graph, or delays of any length.

Takes: populations of different peers on complete graphs; or a few sites that hear each other.
Gives: `of_populations`, `of_loop`; `Places`, `senders_of`.
Guarantees: the determinant's size is what is sent in a frame, by one peer of each role or by the few sites,
whatever the number of peers or the length of a delay.
Does not: find its zeros (see `zeros`).

A peer on a complete graph hears r_i = c_i L(ζ) (σ − s_i), with σ the sum of what all send and L the delays:
hearing −c_i of itself makes it a site T_i, s_i = T_i L σ, and det(I − Σ_i T_i L) = 0. Sites that hear each
other by weights, r_g = Σ_h W_gh ζ^(−lag) s_h, are det(I − T W) = 0, T = diag(T_g): no state for a packet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.eigen.bordered import wires_of
from apc.eigen.closing import Coupling
from apc.eigen.peers import PeerGroup
from apc.frame.exchange import Exchange, check_mean
from apc.frame.schedule import Heard, Sent, Way
from apc.large.characteristic import Characteristic
from apc.large.populations import Population, hear_themselves, rows_of
from apc.large.transfer import Sites, transfer_of

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def senders_of(listed: Sequence[Population], exchange: Exchange) -> list[Floats]:
    """Return, for each population, how many others each line of r could hear on its complete graph (n_r,)."""
    senders = {
        link: float(sum(population.counts.sum() for population in listed if population.sends(link)))
        for link in exchange.links
    }
    return [
        np.array(
            [
                senders[one.way.link] - (1 if population.sends(one.way.link) else 0)
                for one in population.schedule.heard
            ]
        )
        for population in listed
    ]


def heard_weights(listed: Sequence[Population], exchange: Exchange) -> list[Floats]:
    """Return, for each population, what each line of r weighs another's packet by on complete graphs (n_r,).

    Raises
    ------
    ApcError
        E801 a mean over nobody.
    """
    weights = []
    for population, senders in zip(listed, senders_of(listed, exchange), strict=True):
        own = np.ones(len(senders))
        for line, (one, others) in enumerate(zip(population.schedule.heard, senders.tolist(), strict=True)):
            if one.way.operator == "mean":
                first = int(exchange.starts[population.group])
                check_mean(exchange, first, one.way.link, "mean", others > 0, Fraction(others))
                own[line] = 1.0 / others
        weights.append(own)
    return weights


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where in s and r of the whole each population's rows are; how it weighs its own packets and others'."""

    sent: tuple[Integers, ...]
    heard: tuple[Integers, ...]
    own: tuple[Floats, ...]
    others: tuple[Floats, ...]


def of_populations(listed: Sequence[Population], exchange: Exchange) -> tuple[Characteristic, Places]:
    """Return the characteristic function of different peers on complete graphs.

    Parameters
    ----------
    listed
        All peers.
    exchange
        The links, all of them complete.
    """
    roles = [exchange.role(population.group) for population in listed]
    sent_place: dict[tuple[int, Sent], int] = {}
    heard_place: dict[tuple[int, Heard], int] = {}
    for role, population in zip(roles, listed, strict=True):
        for sent in population.schedule.sent:
            sent_place.setdefault((role, sent), len(sent_place))
        for heard in population.schedule.heard:
            heard_place.setdefault((role, heard), len(heard_place))
    group_of = {
        role: population.group for role, population in reversed(list(zip(roles, listed, strict=True)))
    }

    def on_the_way(way: Way, sender: int, receiver: int) -> bool:
        return exchange.delay(way.link, group_of[sender], group_of[receiver]) == way.delay

    others = heard_weights(listed, exchange)
    places = Places(
        sent=tuple(
            np.array([sent_place[role, one] for one in population.schedule.sent], np.int64)
            for role, population in zip(roles, listed, strict=True)
        ),
        heard=tuple(
            np.array([heard_place[role, one] for one in population.schedule.heard], np.int64)
            for role, population in zip(roles, listed, strict=True)
        ),
        own=tuple(
            -weight * np.array([float(on_the_way(one.way, role, role)) for one in population.schedule.heard])
            for role, population, weight in zip(roles, listed, others, strict=True)
        ),
        others=tuple(others),
    )
    sites = []
    for g, population in enumerate(listed):
        k = len(population.parameters)
        own, weight = (np.tile(row, (k, 1)) for row in (places.own[g], places.others[g]))
        maps = hear_themselves(population.lifted, population.schedule, own, weight)
        sites.append(Sites(maps, population.counts, places.sent[g], places.heard[g]))
    lags = sorted({heard.lag for _, heard in heard_place})
    weights = np.zeros((len(lags), len(heard_place), len(sent_place)))
    for (receiver, heard), line in heard_place.items():
        for (sender, sent), row in sent_place.items():
            if sent == heard.sent and on_the_way(heard.way, sender, receiver):
                weights[lags.index(heard.lag), line, row] = 1.0
    return _function(sites, tuple(lags), weights, np.zeros_like(weights)), places


def of_loop(sites: Sequence[PeerGroup], coupling: Coupling, doubts: Mapping[Way, float]) -> Characteristic:
    """Return the characteristic function of a few sites that hear each other, delays of any length.

    Parameters
    ----------
    sites
        The K sites.
    coupling
        What each hears of each, W (K, K) by way.
    doubts
        By how much each entry of a way's W may be off, where it isn't exact.
    """
    sent_starts = np.cumsum([0, *(len(group.schedule.sent) for group in sites)])
    heard_starts = np.cumsum([0, *(len(group.schedule.heard) for group in sites)])
    listed = []
    for g, group in enumerate(sites):
        rows = np.arange(sent_starts[g], sent_starts[g + 1])
        lines = np.arange(heard_starts[g], heard_starts[g + 1])
        listed.append(Sites(rows_of(group.lifted, 1).bounded, np.ones(1), rows, lines))
    return _function(listed, *wires_of(sites, coupling, doubts))


def _function(
    sites: Sequence[Sites], lags: tuple[int, ...], weights: Floats, errors: Floats
) -> Characteristic:
    """Return f of sites that hear each other by weights (l, n_r, n_s), which may be off by so much."""
    n_r, n_s = weights.shape[1:]
    known = np.stack([weights, errors, np.zeros_like(weights)]).reshape(3, len(lags), n_r * n_s)
    return Characteristic(transfer_of(sites, n_s, n_r), np.array(lags, np.int64), known)
