"""The periods of a real-time run, between joins and leaves of peers.

Takes: the simulation of all peers, with packets as they arrive; a peer.
Gives: `Period`, `periods_of`; `means_at_joins`.
Guarantees: in a period the numbers of peers in means, shared masses and formulas are those of the present
peers.
Does not: execute a period (see `peer`).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.source.reading import fault
from apc.simulation.presence import location_of, stored_names
from apc.simulation.signals import sent_states
from apc.simulation.simulation import Simulation, prepare
from apc.support.extension_table import require_extension

Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Period:
    """The frames from `first` until before `until`, in which the same peers are present.

    `peers` are the numbers of the present peers; `joined` and `local` are the indices, among them, of those
    that join at `first` and of the local peer, `groups` those of their groups. `links` are, by route, the
    indices of the directed links of `simulation` among those of all peers.
    """

    first: int
    until: int
    peers: Integers
    joined: Integers
    local: int
    groups: Integers
    simulation: Simulation
    links: tuple[Integers, ...]


def periods_of(simulation: Simulation, local: int, frames: int) -> list[Period]:
    """Return the periods of a run in which a peer is present, in order.

    Parameters
    ----------
    simulation
        The simulation of all peers.
    local
        The number of the peer.
    frames
        The number of frames of the run.

    Raises
    ------
    ApcError
        Those of `prepare` for the present peers.
    """
    presence, routes = simulation.presence, simulation.population.exchange_program.routes
    counts = [group.count for group in simulation.model.groups]
    groups = np.repeat(range(len(counts)), counts)
    if presence is None:
        peers, none = np.arange(len(groups)), np.empty(0, np.int64)
        every = tuple(np.arange(len(route.pairs)) for route in routes)
        return [Period(0, frames, peers, none, local, groups, simulation, every)]
    extension = require_extension("changing_counts")
    changes = (presence.changes(frames * simulation.frame - 1) // simulation.frame).tolist()
    periods = []
    for first, until in pairwise([0, *changes, frames]):
        present = presence.at(np.array([first * simulation.frame]))[0]
        if not present[local]:
            continue
        peers = np.flatnonzero(present)
        index = int(np.searchsorted(peers, local))
        name = simulation.model.groups[groups[local]].name
        number = 1 + int((groups[peers[:index]] == groups[local]).sum())
        model = extension.model_of_present(simulation.topology, present)
        prepared = prepare(model, simulation.settings, signals=[f"{name}[{number}].*"], live=True)
        now_routes = zip(prepared.population.exchange_program.routes, routes, strict=True)
        links = tuple(extension.pair_indices(peers[now.pairs], every.pairs) for now, every in now_routes)
        joined = np.flatnonzero((presence.joins[peers] == first * simulation.frame) & (first > 0))
        periods.append(Period(first, until, peers, joined, index, groups[peers], prepared, links))
    return periods


def means_at_joins(model: Model) -> list[dict[tuple[str, str], int]]:
    """Return by group the states that are means at a joining peer, by the link and channel that send them.

    Raises ApcError E914 for a value that is a mean at a joining peer, and is not sent unchanged to all peers.
    """
    complete = {link.name for link in model.links if link.graph.shape == "complete"}
    result = []
    for group in model.groups:
        peer_type = model.peer_types[group.peer_type]
        names = [name for name in stored_names(peer_type) if peer_type.joins_at_mean(name)]
        means = {
            channel: row
            for row, channels in sent_states(peer_type).items()
            for channel in channels
            if channel[0] in complete and peer_type.states[row].name in names
        }
        sent = [peer_type.states[row].name for row in means.values()]
        joins = [item for item in model.experiment.joins if item.peer.strip().startswith(f"{group.name}[")]
        if joins and (unsent := [name for name in names if name not in sent]):
            subject = f"joining of {unsent[0].partition('.')[0]} in apc run"
            expected = f"start, as {unsent[0]} is not sent to all peers"
            location = location_of(model, "joins", joins[0])
            raise fault("E914", location, subject, expected, "mean", "joining: start")
        result.append(means)
    return result
