"""How many different peers answer a push at one of them: on complete graphs, at a cost that grows as they do.

Takes: a `CompiledSystem` with what `analysis.prepare` made of it, and two devices.
Gives: `PopulationResponses`.
Guarantees: as `answers`; no matrix of more than one peer is made, or of what is sent in a frame.
Does not: serve peers that are not linear, or graphs that are not complete; take norms.

What is sent by all, σ, comes back to each as W σ, W the delays, and each peer answers what it hears and, one
of them, the push (see `determinant`): σ = T W σ + s, s being what the pushed peer sends by itself. T is the
sum of what peers are known by, their poles and residues. Once σ is known each peer is one small system.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, timed
from apc.compiler.compiled import CompiledSystem
from apc.compiler.language.vectors import whole_and_index
from apc.eigen.peers import PeerGroup, group_of_row
from apc.frame.batch_lift import lift_sites
from apc.frame.devices import Device
from apc.frame.discretize import UNIT
from apc.frame.exchange import build_exchange
from apc.frame.linearize import linearize_rows, sites_of_rows
from apc.frame.parameters import resolve
from apc.hands.answers import AbstractResponses, check_kicks, copy_of, held_device, nothing
from apc.hands.asked import Port
from apc.hands.response import (
    Carried,
    Pushed,
    add,
    answer,
    exponential,
    motions,
    open_site,
    open_sites,
    pushed_alone,
    scaled,
    solved,
    spectra,
)
from apc.large.characteristic import matrices_at
from apc.large.determinant import of_populations
from apc.large.populations import hear_themselves, populations, rows_of
from apc.large.translation import count_translations, representatives

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Peers opened together: their matrices hold what is read of a frame as well.
CHUNK = 64


class PopulationResponses(AbstractResponses):
    """The answers to a push of one peer of many that differ."""

    def __init__(self, system: CompiledSystem, prepared: Prepared, port: Port, other: Port) -> None:
        numbers = resolve(system)
        prepared = timed(system, prepared, numbers)
        self.exchange = build_exchange(system, numbers.timings)
        self.listed = populations(system, prepared.jacobians, prepared.schedules, numbers)
        self.function, self.places = of_populations(self.listed, self.exchange)
        self.alike = representatives(self.listed, self.exchange)
        unit_of = {one.name: one.unit for one in system.parameters}
        self.port, self.across = port, other
        self.at_port, self.at_other = (self._population(one) for one in (port, other))
        groups = [self._peer(one) for one in (port, other)]
        along = self.at_port == self.at_other or whole_and_index(port.part)[1]
        named = other.part or (port.part if along else "")
        self.other = held_device(system, prepared, groups[1], named, unit_of)
        self.device = held_device(system, prepared, groups[0], port.part, unit_of)
        for group in groups:
            check_kicks(system, group)
        self.pushed = self._alone(self.at_port, groups[0], self.device)
        self.shaken = self._alone(self.at_other, groups[1], self.other)
        self.copies = [copy_of(group, self.device) for group in self.alike]
        own = self.copies[self.at_port]
        self.copy = own[0] if own else ""
        self.frame = float(self.pushed.frame)

    @functools.cached_property
    def drifting(self) -> bool:  # type: ignore[override]  # asked for only at multiples of the frame rate
        """Whether the scene may rest anywhere."""
        return count_translations(self.listed, self.exchange) != 0

    def at(self, s: Complex, aliases: Sequence[int] = (0,), *, apart: bool = True) -> list[Carried]:
        """Return the velocity here at each alias, the velocity there, and the copy's error (k,)."""
        alone = answer(self.pushed, 0, s)
        heard = self._heard(alone, s)
        moved = answer(self.pushed, None, s, self._own(heard, self.at_port))
        read = add(alone, moved)
        found = motions(self.pushed, read, 0, [(0, self.device.velocity, alias) for alias in aliases], s)
        there = [(0, self.other.velocity, 0)]
        if self.port.peer == self.across.peer:
            found += motions(self.pushed, read, 0, there, s)
        else:
            found += spectra(self.shaken, None, there, s, self._own(heard, self.at_other))
        found.append(self._error(read, moved, heard, s) if apart else nothing(s))
        return [(value, np.where(np.isnan(off), np.inf, off)) for value, off in found]

    def _population(self, one: Port) -> int:
        """Return the population that a peer is of."""
        return int(np.searchsorted(self.exchange.starts, one.peer, side="right")) - 1

    def _peer(self, one: Port) -> PeerGroup:
        """Return a peer by itself."""
        place = self._population(one)
        population = self.listed[place]
        row = population.rows[one.peer - int(self.exchange.starts[place])]
        return group_of_row(
            population.jacobians,
            population.parameters[row],
            population.schedule,
            self.exchange,
            population.group,
            1,
        )

    def _alone(self, place: int, group: PeerGroup, device: Device) -> Pushed:
        """Return a peer of a population that may be pushed, and hears the others from outside."""
        own, site = open_site(group, device)
        weights = (self.places.own[place][None], self.places.others[place][None])
        maps = hear_themselves(rows_of(own.lifted, 1), own.schedule, *weights)
        return pushed_alone(maps.row(0).bounded, site)

    def _heard(self, alone: Carried, s: Complex) -> Carried:
        """Return all that is heard from outside, on every line (k, n_r), of what the pushed peer sends."""
        lines, rows = self.function.weights.shape[1:]
        if not rows:
            return np.zeros((len(s), lines), np.complex128), np.zeros((len(s), lines))
        sent = np.zeros((len(s), rows), np.complex128), np.zeros((len(s), rows))
        for whole, own in zip(sent, alone, strict=True):
            whole[:, self.places.sent[self.at_port]] = own[:, own.shape[1] - self.pushed.sent :]
        points, reach = exponential(s, self.pushed.frame)
        found = matrices_at(self.function, points, reach)
        loose = found.doubt + reach[:, None, None] * np.abs(found.slope)
        value, off = (one[:, :, None] for one in solved(found.value, loose, sent))
        weight, charge = np.abs(found.weight), (rows + 4) * UNIT
        bound = (weight + found.weight_doubt) @ off
        bound += (found.weight_doubt + charge * weight) @ np.abs(value)
        return (found.weight @ value)[:, :, 0], bound[:, :, 0] * (1 + charge)

    def _own(self, heard: Carried, place: int) -> Carried:
        """Return what the peers of a population hear of it."""
        value, off = heard
        return value[:, self.places.heard[place]], off[:, self.places.heard[place]]

    def _error(self, read: Carried, moved: Carried, heard: Carried, s: Complex) -> Carried:
        """Return how far the copy here is from the mean of all others' of its name."""
        own = self.copies[self.at_port]
        alike = [(place, one[1]) for place, one in enumerate(self.copies) if own and one and one[0] == own[0]]
        others = sum(int(self.listed[place].counts.sum()) for place, _ in alike) - 1
        if own is None or others < 1:
            return nothing(s)
        wanted = [(0, own[1], 0)]
        (here,) = motions(self.pushed, read, 0, wanted, s)
        (found,) = motions(self.pushed, moved, None, wanted, s)  # it is not one of the others
        found = add(here, scaled(found, 1 / others))
        for place, row in alike:
            listening = self._own(heard, place)
            for count, one in self._listeners(place):
                (copy,) = spectra(one, None, [(0, row, 0)], s, listening)
                found = add(found, scaled(copy, -count / others))
        return found

    def _listeners(self, place: int) -> Iterator[tuple[float, Pushed]]:
        """Yield the different peers of a population, opened, and how many there are of each."""
        population, group = self.listed[place], self.alike[place]
        rows = linearize_rows(population.jacobians, population.parameters)
        for start in range(0, len(rows), CHUNK):
            many = sites_of_rows(population.jacobians, rows[start : start + CHUNK])
            opened, schedule, sites = open_sites(group, many)
            weights = [np.tile(one[place], (len(sites), 1)) for one in (self.places.own, self.places.others)]
            maps = hear_themselves(lift_sites(opened, schedule), schedule, *weights)
            for row, site in enumerate(sites):
                yield float(population.counts[start + row]), pushed_alone(maps.row(row).bounded, site)
