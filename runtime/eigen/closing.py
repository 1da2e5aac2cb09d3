"""Close a loop: what each site hears is what the others send, and one matrix moves them all.

Takes: groups of equal peers, and what each weighs the packets of each other by.
Gives: `ModalSystem`, `Coupling`, `without_packets`; `DelayedSample`, `StateLayout`, `lay_out`; `ClosedLoop`,
`close_loop`; `InterconnectionMatrices`, `bounded_weight`, `feedback_of`, `close`, `close_outside`.
Guarantees: the state holds, site by site, z and then the packets on their way, in order of row and age. The
matrix of `close_loop` comes with a bound on its rounding error, entry by entry; `close` takes one system or
many (k, …), real or complex.
Does not: know where the weights come from (see `modes`, `graph_loops`); compute eigenvalues (see `spectrum`).

    r_g = Σ_h W_gh s_h        each packet as old as its receiver finds it
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.graph_modes import Surd
from apc.eigen.peers import PeerClass, states_of
from apc.frame.lift import FrameMap
from apc.frame.radius import FLOATS, RADII, UNIT, Arithmetic, common_shape, radius_of, value_of
from apc.frame.schedule import CouplingTerm, Schedule

Floats = NDArray[np.float64]
Matrix = NDArray[Any]  # float64 or complex128; of balls where it says so

# What site g hears of site h on a way: the weight on h's packet.
Coupling = Mapping[CouplingTerm, tuple[tuple[Fraction, ...], ...]]


@dataclass(frozen=True, slots=True)
class ModalSystem:
    """Some sites and what each hears of each, `coupling`: a closed system before its matrix is built.

    The whole holds it `multiplicity` times. `doubts` and `surds` as in `ClosedLoop`.
    """

    name: str
    multiplicity: int
    sites: tuple[PeerClass, ...]
    coupling: Coupling
    doubts: Mapping[CouplingTerm, float] = field(default_factory=dict)
    surds: Mapping[CouplingTerm, Surd] = field(default_factory=dict)

    @property
    def packets(self) -> tuple[DelayedSample, ...]:
        """The packets on their way, in order of state."""
        return tuple(
            DelayedSample(h, row, lag)
            for h, group in enumerate(self.sites)
            for row, depth in enumerate(group.schedule.depths)
            for lag in range(1, depth + 1)
        )

    @property
    def layout(self) -> StateLayout:
        """What the state holds, laid out anew each time."""
        return lay_out_loop(self)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the state."""
        return self.layout.names

    @property
    def states(self) -> int:
        """How many states there are."""
        return sum(states_of(group.schedule, group.jacobians) for group in self.sites)


@dataclass(frozen=True, slots=True)
class DelayedSample:
    """A packet that is still to be heard: row of s of site `site`, sent `lag` frames ago (1 or more)."""

    site: int
    row: int
    lag: int


@dataclass(frozen=True, slots=True)
class StateLayout:
    """The state of a closed system: where each site's part starts, its names, and where each packet is."""

    offsets: tuple[int, ...]
    names: tuple[str, ...]
    places: Mapping[DelayedSample, int]  # in order of state

    @property
    def packets(self) -> tuple[DelayedSample, ...]:
        """The packets on their way, in order of state."""
        return tuple(self.places)


def without_packets(loop: ModalSystem) -> ModalSystem:
    """Return the loop with no packet in its state: how many motions are rigid does not depend on delays."""
    sites = tuple(
        replace(group, schedule=replace(group.schedule, depths=(0,) * len(group.schedule.depths)))
        for group in loop.sites
    )
    return replace(loop, sites=sites)


def lay_out(z_names: Sequence[Sequence[str]], schedules: Sequence[Schedule]) -> StateLayout:
    """Lay out a state: site by site what its z is named, then its packets."""
    offsets: list[int] = []
    names: list[str] = []
    places: dict[DelayedSample, int] = {}
    for site, (z_name, schedule) in enumerate(zip(z_names, schedules, strict=True)):
        offsets.append(len(names))
        names += z_name
        over, under = (schedule.quantum * 1000).as_integer_ratio()  # there are thousands of packets
        for row, depth in enumerate(schedule.depths):
            for lag in range(1, depth + 1):
                when = (schedule.sent_times[row] - lag * schedule.frame) * over / under
                places[DelayedSample(site, row, lag)] = len(names)
                names.append(f"{schedule.sent_names[row]}({when:.6g} ms)")
    return StateLayout(tuple(offsets), tuple(names), places)


def lay_out_loop(loop: ModalSystem | ClosedLoop) -> StateLayout:
    """Lay out the state of a loop; of several sites, each name says whose it is."""
    groups = loop.sites
    layout = lay_out([group.z_names for group in groups], [group.schedule for group in groups])
    if len(groups) == 1:
        return layout
    sizes = np.diff([*layout.offsets, len(layout.names)])
    owners = (group.name for group, size in zip(groups, sizes, strict=True) for _ in range(size))
    return replace(
        layout, names=tuple(f"{owner}.{name}" for owner, name in zip(owners, layout.names, strict=True))
    )


@dataclass(frozen=True, slots=True, eq=False)
class ClosedLoop:
    """One autonomous system: state⁺ = `matrix` · state, once a frame.

    `layout` says what the state holds; `motion` where in it the continuous states are (site by site). `error`
    bounds the rounding error of the matrix entry by entry. `heard` is what each site hears in a frame, over
    the state. `doubts` say by how much each weight of a way may be off; `surds`, of a system of one site,
    what its weights are in closed form.
    """

    name: str
    multiplicity: int
    sites: tuple[PeerClass, ...]
    coupling: Coupling
    frame_s: float
    layout: StateLayout
    matrix: Floats  # (n, n)
    error: Floats  # (n, n)
    heard: tuple[Floats, ...]  # (n_r, n), one a site
    motion: tuple[int, ...]
    doubts: Mapping[CouplingTerm, float] = field(default_factory=dict)
    surds: Mapping[CouplingTerm, Surd] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the state."""
        return self.layout.names

    @property
    def offsets(self) -> tuple[int, ...]:
        """Where each site's part of the state starts."""
        return self.layout.offsets

    @property
    def packets(self) -> tuple[DelayedSample, ...]:
        """The packets on their way, in order of state."""
        return self.layout.packets


def close_loop(loop: ModalSystem | ClosedLoop) -> ClosedLoop:
    """Let K sites hear each other: r_g = Σ_h W_gh s_h, each packet as old as its receiver finds it."""
    maps = [group.lifted for group in loop.sites]
    layout = lay_out_loop(loop)
    closed = close(maps, feedback_of(loop, layout), layout, numbers=RADII)
    return ClosedLoop(
        name=loop.name,
        multiplicity=loop.multiplicity,
        sites=loop.sites,
        coupling=loop.coupling,
        frame_s=float(loop.sites[0].schedule.frame_s),
        layout=layout,
        matrix=value_of(closed.matrix),
        error=radius_of(closed.matrix),
        heard=tuple(map(value_of, closed.heard)),
        motion=tuple(
            offset + place
            for group, offset in zip(loop.sites, layout.offsets, strict=True)
            for place in range(len(group.site.kind.states))
        ),
        doubts=loop.doubts,
        surds=loop.surds,
    )


@dataclass(frozen=True, slots=True, eq=False)
class InterconnectionMatrices:
    """What a site hears, r = `now` s + `before` x, in floats or with their radii.

    s are the packets that all sites send in this frame, site by site; x is the state, and behind it, if
    `before` has more columns, what comes from outside.
    """

    now: Matrix  # (n_r, n_s)
    before: Matrix  # (n_r, n)

    @property
    def plain(self) -> InterconnectionMatrices:
        """The weights without their radii."""
        return InterconnectionMatrices(value_of(self.now), value_of(self.before))


@dataclass(frozen=True, slots=True, eq=False)
class ClosedLoopMatrices:
    """A closed loop over its state and what comes from outside: what it becomes, is heard and is sent.

    `turns` says how many packets in a row are sent upon one another in a frame.
    """

    matrix: Matrix  # (n, n) or more columns
    heard: tuple[Matrix, ...]  # one a site
    sent: Matrix  # of all sites, one below the other


def bounded_weight(weight: Fraction, doubt: float) -> tuple[float, float]:
    """Return a weight as a float and what that may be off by: its doubt, and its rounding if it has any."""
    known = float(weight)
    is_exact = known.as_integer_ratio() == weight.as_integer_ratio()  # a Fraction compares far slower
    return known, doubt if is_exact else doubt + UNIT * abs(known)


def feedback_of(loop: ModalSystem | ClosedLoop, layout: StateLayout) -> list[InterconnectionMatrices]:
    """Return what each site hears, each weight with the radius of its doubt and of its rounding."""
    row_of = [{sent: row for row, sent in enumerate(group.schedule.sent)} for group in loop.sites]
    starts = np.cumsum([0] + [len(group.schedule.sent) for group in loop.sites]).tolist()
    # Few weights at many places: each is looked at once, and plain keys are found faster than packets.
    places = {(packet.site, packet.row, packet.lag): place for packet, place in layout.places.items()}
    known: dict[tuple[int, int, float], tuple[float, float]] = {}
    feedbacks = []
    for g, group in enumerate(loop.sites):
        now = np.zeros((2, len(group.schedule.heard), starts[-1]))
        before = np.zeros((2, len(group.schedule.heard), len(layout.names)))
        for line, heard in enumerate(group.schedule.heard):
            doubt = loop.doubts.get(heard.way, 0.0)
            columns, weights = [], []
            for h, weight in enumerate(loop.coupling[heard.way][g]):
                if not (weight or doubt):
                    continue
                key = weight.numerator, weight.denominator, doubt
                row = row_of[h][heard.sent]
                columns.append(places[h, row, heard.lag] if heard.lag else starts[h] + row)
                weights.append(known.get(key) or known.setdefault(key, bounded_weight(weight, doubt)))
            if columns:
                (before if heard.lag else now)[:, line, columns] = np.array(weights).T
        feedbacks.append(InterconnectionMatrices(now, before))
    return feedbacks


def close(
    maps: Sequence[FrameMap],
    feedback: Sequence[InterconnectionMatrices],
    layout: StateLayout,
    *,
    numbers: Arithmetic = FLOATS,
) -> ClosedLoopMatrices:
    """Close a loop, or many of one layout (k, …).

    Parameters
    ----------
    maps, feedback
        Each site's, over real or complex numbers.
    layout
        The state's.
    numbers
        What all of them are of.

    Notes
    -----
    Packets heard in the frame they are sent in make a loop within the frame, s = S z + D r and r = W₀ s + …,
    that time orders: D W₀ is nilpotent, and I − D W₀ is solved exactly by as many steps as there are packets.
    """
    n, columns = len(layout.names), feedback[0].before.shape[-1]
    parts = [block for frame_map in maps for block in frame_map.blocks] + [item.before for item in feedback]
    many = common_shape(*(block.shape[:-2] for block in parts))
    number = np.result_type(*parts)
    starts = np.cumsum([0] + [frame_map.s.shape[-2] for frame_map in maps])
    rows = [
        slice(start, start + frame_map.s.shape[-2]) for frame_map, start in zip(maps, starts, strict=False)
    ]
    z = [
        slice(offset, offset + frame_map.p.shape[-1])
        for frame_map, offset in zip(maps, layout.offsets, strict=True)
    ]
    sent = np.zeros((*many, starts[-1], columns), dtype=number)
    for frame_map, heard, row, place in zip(maps, feedback, rows, z, strict=True):
        if numbers.vanishes(frame_map.d):
            sent[..., row, place] = frame_map.s
        else:
            _put(sent[..., row, :], place, frame_map.s, frame_map.d, heard.before, numbers)
    at_once = any(heard.now.any() for heard in feedback)
    if at_once:
        within = np.zeros((*many, starts[-1], starts[-1]), dtype=number)
        for frame_map, heard, row in zip(maps, feedback, rows, strict=True):
            within[..., row, :] = numbers.multiply(frame_map.d, heard.now)
        sent = _sent_in_turn(within, sent, numbers)
    matrix = np.zeros((*many, n, columns), dtype=number)
    received = []
    for frame_map, heard, place in zip(maps, feedback, z, strict=True):
        r = numbers.add(numbers.multiply(heard.now, sent), heard.before) if at_once else heard.before
        received.append(r)
        _put(matrix[..., place, :], place, frame_map.p, frame_map.q, r, numbers)
    unit = numbers.exact(np.array(1))
    for packet, at in layout.places.items():  # each grows older by a frame
        if packet.lag == 1:
            matrix[..., at, :] = sent[..., starts[packet.site] + packet.row, :]
        else:
            matrix[..., at, layout.places[DelayedSample(packet.site, packet.row, packet.lag - 1)]] = unit
    return ClosedLoopMatrices(matrix, tuple(received), sent)


def close_outside(
    loop: ModalSystem | ClosedLoop,
    maps: Sequence[FrameMap],
    ways: Sequence[int],
    layout: StateLayout,
    *,
    numbers: Arithmetic = FLOATS,
) -> ClosedLoopMatrices:
    """Close a loop into whose sites something comes from outside: over the state, and that behind it.

    Parameters
    ----------
    loop
        The loop.
    maps
        Those of its sites, what comes from outside the last that they hear.
    ways
        How much that is, of each site.
    layout
        The state's.
    numbers
        What the maps are of.
    """
    total, first = sum(ways), 0
    feedback = []
    for many, known in zip(ways, feedback_of(loop, layout), strict=True):
        plain = known if numbers is RADII else known.plain
        around = plain.now.shape[:-2]
        now = np.zeros((*around, plain.now.shape[-2] + many, plain.now.shape[-1]))
        before = np.zeros((*around, now.shape[-2], len(layout.names) + total))
        heard = plain.now.shape[-2]
        now[..., :heard, :], before[..., :heard, : len(layout.names)] = plain.now, plain.before
        columns = len(layout.names) + first
        before[..., heard:, columns : columns + many] = numbers.exact(np.eye(many))
        feedback.append(InterconnectionMatrices(now, before))
        first += many
    return close(maps, feedback, layout, numbers=numbers)


def _put(
    rows: Matrix, z: slice, matrix: Matrix, of_heard: Matrix, heard: Matrix, numbers: Arithmetic
) -> None:
    """Write what a site makes of its own z, and of what it hears, into its rows over the state."""
    rows[...] = numbers.multiply(of_heard, heard)
    rows[..., z] = matrix if numbers.vanishes(heard[..., z]) else numbers.add(rows[..., z], matrix)


def _sent_in_turn(within: Matrix, alone: Matrix, numbers: Arithmetic) -> Matrix:
    """Return (1 − D W₀)⁻¹ times what is sent without hearing anybody in this frame; NaN where a part is."""
    sent = term = alone
    for _ in range(within.shape[-1]):
        term = numbers.multiply(within, term)
        if numbers.vanishes(term):
            return sent
        sent = numbers.add(sent, term)
    assert not (np.isfinite(term) & (term != 0)).any(), "a packet is heard before it is sent"
    return sent
