"""What devices are pushed by, while hands move them as they like: one map a mode.

Takes: a `CompiledSystem`.
Gives: `PortLoop`, `Maps`, `port_loops`; `Opened`, `Openings`, `open_ports`; `Cut`, `port_loop`; `reciprocal`.
Guarantees: exact for any motion of the hands: where nothing samples a device and no force on it switches,
only how far it went counts, and the least that its damping takes of that. Matrices carry the radius of their
rounding.
Does not: say whether energy can be drawn (see `passivity`).

Between two instants, τ apart, a device moves by Δ against a constant force f and its damper b. The hand gives
∫F v = ΔE + b ∫v² + f Δ, and ∫v² ≥ Δ²/τ, with equality for a constant velocity. All that others can do depends
on the Δ alone, so the hand can draw energy if and only if Σ f Δ + b Δ²/τ can fall below all bounds. With the
map H from Δ to f this is a question of He H(e^{jθ}) + diag(b/τ).

Devices that stand aside by 1 are pushed back by K for ever: H has the pole K/(z − 1), whose Hermitian part on
the circle is −K/2 for all θ. It is taken out, with what all else moves by when devices stand aside; what
remains has the motions of the scene with devices clamped, and no others.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.eigen.balls import BALLS
from apc.eigen.closing import Loop, close_loop
from apc.eigen.modes import arrange, dense_loop
from apc.eigen.peers import MOST_STATES, PeerGroup, states_of
from apc.eigen.relative import relative_coordinates, relative_rows, with_doubt
from apc.eigen.rigid import find_rigid_modes
from apc.frame.devices import Device, coupled_directly, find_device, no_device
from apc.frame.discretize import UNIT
from apc.frame.exchange import Exchange
from apc.frame.ports import Ports, with_holds, with_ports
from apc.frame.radius import FLOATS, RADII, Arithmetic, radius_of, value_of, with_radius
from apc.frame.schedule import Act, Propagate, Schedule, Send, Tick
from apc.frame.site import LinearSite
from apc.frame.taylor import hull

Floats = NDArray[np.float64]
Places = NDArray[np.intp]
Matrix = NDArray[Any]

# Graphs whose modes are orthogonal: what hands give all peers together is the sum of what they give each.
ORTHOGONAL = ("complete", "ring")

# How alike devices feel each other to count alike: far more than rounding.
EVEN = 1e-9

# Intervals of all devices of a mode together.
MOST_INTERVALS = 400


@dataclass(frozen=True, slots=True)
class Touched:
    """A peer's device: its damping in N·s/m, how long each of its intervals is, and where they are in z."""

    damping: Fraction
    seconds: tuple[Fraction, ...]
    ports: Ports


@dataclass(frozen=True, slots=True, eq=False)
class Maps:
    """A map from how far devices move to what pushes them back, less its pole at rest.

    `a`, `b`, `c`, `d` (2, …) are over the states of the scene with clamped devices; `weight` (2, m, m) is
    what is added to the Hermitian part: dampers, and the pole's. Inputs and outputs are scaled: 1 more on the
    diagonal of `weight` is 1 N·s/m more at each device. `static` (2, k, k) is the stiffness of the pole
    between the k kinds of devices, of all peers together. `joined` says that the energies of all devices
    count alike, so that hands may be joined to each other. Of many points in floats, all begin with (k, …)
    instead.
    """

    a: Matrix
    b: Matrix
    c: Matrix
    d: Matrix
    weight: Matrix
    static: Matrix
    joined: bool


@dataclass(frozen=True, slots=True, eq=False)
class PortLoop:
    """A mode of devices that hands move: its `maps`, the devices' dampings in N·s/m, and its intervals.

    `seconds` are how long those are, `starts` when they begin in the frame.
    """

    name: str
    multiplicity: int
    maps: Maps
    dampings: tuple[Fraction, ...]
    starts: Floats
    seconds: Floats
    frame_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Opened:
    """A peer group whose device is moved from outside: the group that it was, its device and what is touched.

    `ported` is the group with ways in and out, `at` the instants at which its intervals begin, in quanta.
    """

    group: PeerGroup
    device: Device
    ported: PeerGroup
    touched: Touched
    at: tuple[int, ...]

    def site(self, site: LinearSite, inverse: Matrix) -> LinearSite:
        """Return a site, or many (k, …), of the group with the ways in and out; 1/m is `inverse` (k,)."""
        (found,), _, _ = _with_ways([site], [inverse], self.group.schedule, self.device, self.at)
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Openings:
    """A scene whose devices are moved from outside, all of them: groups, and loops that share no energy.

    `weighted` says that a site of a loop stands for as many peers as it counts.
    """

    scene: str
    groups: tuple[Opened, ...]
    loops: tuple[Loop, ...]
    weighted: bool

    def of(self, loop: Loop) -> list[Opened]:
        """Return the groups of a loop's sites that are held."""
        return [self.groups[place] for _, place in self.places(loop)]

    def places(self, loop: Loop) -> list[tuple[int, int]]:
        """Return which of a loop's sites are held, and which of the groups each is."""
        known = {id(one.ported.schedule): place for place, one in enumerate(self.groups)}
        sites = ((number, known.get(id(site.schedule))) for number, site in enumerate(loop.sites))
        return [(number, place) for number, place in sites if place is not None]


def port_loops(system: CompiledSystem, prepared: Prepared, *, option: str) -> tuple[PortLoop, ...] | str:
    """Return the modes of a scene in which hands move all devices; or why no device is ever passive.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `analysis.prepare` made of it.
    option
        What asked for it.

    Raises
    ------
    ApcError
        E931 no device, or none that can be cut out; E933 too many intervals or states.
    """
    found = open_ports(system, *lifted_groups(system, prepared=prepared), option=option)
    if isinstance(found, str):
        return found
    return tuple(port_loop(found, loop, option=option)[0] for loop in found.loops)


def open_ports(
    system: CompiledSystem, groups: Sequence[PeerGroup], exchange: Exchange, *, option: str
) -> Openings | str:
    """Let the devices of all groups be moved from outside; or say why no device is ever passive.

    Parameters
    ----------
    system
        The compiled scene.
    groups, exchange
        From `analysis.lifted_groups`.
    option
        What asked for it.

    Raises
    ------
    ApcError
        As `port_loops`.
    """
    unit_of = {one.name: one.unit for one in system.parameters}
    heard = {
        (receive.link, row)
        for group in groups
        for partition, tick in zip(group.jacobians.kind.clocks, group.exact.ticks, strict=True)
        for receive, column, rows in zip(partition.receives, tick.r.T, tick.channels, strict=True)
        if column.astype(np.bool_).any()
        for row in rows
    }
    direct = coupled_directly(system.kinds)
    opened: list[Opened] = []
    ported: list[PeerGroup] = []
    for group in groups:
        device = find_device(group.jacobians, group.parameters, unit_of, group.listening, direct=direct)
        if device is None:  # a server, say: it is not held
            ported.append(group)
            continue
        if isinstance(device, str):
            raise ApcError(Mistake("E931", Place(system.origin.topology), f"{option}: {device}"))
        felt = _felt_velocity(group, device, heard)
        if felt:
            return felt
        if touch := _other_touch(group, device):
            why, hint = touch
            raise ApcError(Mistake("E933", Place(system.origin.topology), f"{option}: {why}", hint=hint))
        opened.append(_opened(group, device))
        ported.append(opened[-1].ported)
    if not opened:
        raise no_device(system, option)
    loops, weighted = _loops(system, ported, exchange, option=option)
    moved = {id(one.ported.schedule) for one in opened}
    # A loop in which nothing is held is one of the scene with its devices clamped.
    loops = tuple(loop for loop in loops if any(id(site.schedule) in moved for site in loop.sites))
    return Openings(system.origin.topology, tuple(opened), loops, weighted)


def _felt_velocity(group: PeerGroup, device: Device, heard: Set[tuple[str, int]]) -> str:
    """Say what samples a device's velocity, "" if nothing does: of what is sent, the channels heard count."""
    kind = group.jacobians.kind
    for partition, tick in zip(kind.clocks, group.exact.ticks, strict=True):
        for row in np.flatnonzero(tick.x[:, device.velocity].astype(np.bool_)):
            name = partition.outputs[row % len(partition.outputs)]
            return (
                f"{name} samples the velocity of {device.part}, and a hand that moves it just then, and "
                "hardly at all, gets any force for nothing"
            )
    for sending, send in zip(kind.sends, group.exact.sends, strict=True):
        rows = np.flatnonzero(send.x[:, device.velocity].astype(np.bool_))
        if any((sending.link, row) in heard for row in rows.tolist()):
            return f"the velocity of {device.part} is sent over {sending.link} as sampled"
    return ""


def _other_touch(group: PeerGroup, device: Device) -> tuple[str, str] | None:
    """Say what touches a device otherwise than by samples and held forces, and what to write instead."""
    a, own = group.exact.a, [device.position, device.velocity]
    others = [place for place in range(len(a)) if place not in own]
    both = a[np.ix_(others, own)].astype(np.bool_) | a[np.ix_(own, others)].T.astype(np.bool_)
    if both.any():
        name = group.jacobians.kind.states[others[int(np.flatnonzero(both.any(axis=1))[0])]].name
        return (
            f"{device.part} and what {name} is of act on one another at every moment",
            "a coupler that acts by sample and hold, as SampledSpringDamper",
        )
    if a[device.velocity, device.position] > 0 or a[device.velocity, device.velocity] > 0:
        return f"a spring or damper of {device.part} to the ground is negative", "values of 0 or more"
    return None


def _opened(group: PeerGroup, device: Device) -> Opened:
    """Return a group whose device is moved from outside."""
    schedule = group.schedule
    at = tuple(_boundaries(group.exact, schedule, device))
    inverses = [np.array(float(device.inverse)), np.array(device.inverse)]
    (site, exact), full, ports = _with_ways([group.site, group.exact], inverses, schedule, device, at)
    ends = np.diff([*at, schedule.frame]).tolist()
    damping = -group.exact.a[device.velocity, device.velocity] / device.inverse
    touched = Touched(damping, tuple(end * schedule.quantum for end in ends), ports)
    return Opened(group, device, group.with_site(site, exact, full), touched, at)


def _with_ways(
    sites: Sequence[LinearSite],
    inverses: Sequence[Matrix],
    schedule: Schedule,
    device: Device,
    at: Sequence[int],
) -> tuple[list[LinearSite], Schedule, Ports]:
    """Return a site in several kinds of number whose device is moved from outside, by 1/m in each."""
    driven, readings = [], []
    for one, inverse in zip(sites, inverses, strict=True):
        driven.append(_driven(one, device))
        push = -one.b[..., device.velocity, :] / inverse[..., None]
        *many, states, _ = driven[-1].b.shape
        zeros = [np.zeros((*many, size), dtype=one.b.dtype) for size in (states, 1)]
        push = np.broadcast_to(push, (*many, push.shape[-1]))
        readings.append(np.concatenate([zeros[0], push, zeros[1]], axis=-1)[..., None, :])
    return with_ports(driven, schedule, 1, at, readings, at)


def _boundaries(site: LinearSite, schedule: Schedule, device: Device) -> list[int]:
    """Return the instants, in quanta, at which a device is sampled or a force on it switches, and 0."""
    found, now, counts = {0}, 0, False
    for event in schedule.events:
        match event:
            case Propagate(duration):
                now += duration
            case Tick(partition, _, _):
                counts = bool(site.ticks[partition].x[:, device.position].astype(np.bool_).any())
            case Send(partition, _):
                counts = bool(site.sends[partition].x[:, device.position].astype(np.bool_).any())
            case Act(hold, _):
                counts = bool(site.b[device.velocity, hold])
        if not isinstance(event, Propagate) and counts and now < schedule.frame:
            found.add(now)
    return sorted(found)


def _driven(site: LinearSite, device: Device) -> LinearSite:
    """Return a site, or many, without a device's states: a hold, the last, says where the device is."""
    own = (device.position, device.velocity)
    kept = np.array([place for place in range(site.a.shape[-1]) if place not in own], dtype=np.intp)
    smaller = replace(
        site,
        kind=replace(site.kind, states=tuple(site.kind.states[place] for place in kept)),
        a=site.a[..., kept[:, None], kept],
        b=site.b[..., kept, :],
        ticks=tuple(replace(tick, x=tick.x[..., kept]) for tick in site.ticks),
        sends=tuple(replace(send, x=send.x[..., kept]) for send in site.sends),
    )
    found = with_holds(smaller, np.zeros((*smaller.b.shape[:-1], 1), dtype=site.b.dtype))
    for tick, whole in zip(found.ticks, site.ticks, strict=True):
        tick.u[..., -1] = whole.x[..., device.position]
    for send, sent in zip(found.sends, site.sends, strict=True):
        send.u[..., -1] = sent.x[..., device.position]
    return found


def _loops(
    system: CompiledSystem, groups: Sequence[PeerGroup], exchange: Exchange, *, option: str
) -> tuple[tuple[Loop, ...], bool]:
    """Return loops that share no energy, and whether a site of them stands for as many peers as it counts."""
    used = {one.way.link for group in groups for one in group.schedule.heard}
    if all(exchange.links[link].graph.shape in ORTHOGONAL for link in used):
        arranged = arrange(groups, exchange)
        if arranged.method == "modes":
            return arranged.loops, True
    states = sum(group.count * states_of(group.schedule, group.jacobians) for group in groups)
    if states > MOST_STATES:
        what = f"{exchange.peers:,} peers on such a graph make one system of {states:,} states and intervals"
        hint = f"equal peers on complete graphs or rings, or {MOST_STATES:,} in all"
        raise ApcError(Mistake("E933", Place(system.origin.topology), f"{option}: {what}", hint=hint))
    return (dense_loop(groups, exchange),), False


@dataclass(frozen=True, slots=True, eq=False)
class _Wires:
    """The intervals of a loop's devices: `into`, `out` (m,) are where in the closed state, `rest` all else.

    `of` (m, k) says of which site each is, `sums` (m, m) which came before it in a frame, `seconds` and
    `starts` (m,) how long it is and when it begins.
    """

    into: Places
    out: Places
    rest: Places
    of: Floats
    sums: Floats
    seconds: Floats
    starts: Floats


def _wires(offsets: Sequence[int], size: int, sites: Sequence[Touched]) -> _Wires:
    """Return where the intervals are of sites whose states begin at offsets."""
    lengths = [len(one.seconds) for one in sites]
    whose = np.repeat(np.arange(len(sites)), lengths)
    starts = np.concatenate([np.cumsum([0.0, *map(float, one.seconds[:-1])]) for one in sites])
    added = [start + place for start, one in zip(offsets, sites, strict=True) for place in one.ports.added]
    pairs = list(zip(offsets, sites, strict=True))
    return _Wires(
        into=np.concatenate([start + one.ports.drawn[:, 0] for start, one in pairs]),
        out=np.concatenate([start + one.ports.read[:, 0] for start, one in pairs]),
        rest=np.delete(np.arange(size), added),
        of=np.eye(len(sites))[whose],
        sums=np.tril(whose[:, None] == whose, -1).astype(np.float64),
        seconds=np.array([float(one) for site in sites for one in site.seconds]),
        starts=starts,
    )


# What is left of standing aside without some directions (2, k, k), and all else along those (2, n, k),
# with their radii.
Standing = tuple[Matrix, Matrix]


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """Where a loop of an opened scene is cut, of a layout that many values share.

    `counts` are what the energies of each site's devices count at first, `rigid` (n, d) the motions that no
    device feels and nothing holds back.
    """

    at: _Wires
    counts: tuple[int, ...]
    rigid: Floats

    def maps(
        self, whole: Matrix, dampings: Matrix, numbers: Arithmetic, stands: Standing | None = None
    ) -> Maps | None:
        """Return the map of a closed matrix, or of many (k, …); None where others' motions can't be told.

        Parameters
        ----------
        whole
            The matrix of the loop, its devices moved from outside.
        dampings
            Of each site's device, N·s/m, a column (…, sites, 1) of what the matrix is of.
        numbers
            What the matrix is of.
        stands
            From `stands_aside`, in numbers with their radii, if the matrix is one over a cell.
        """
        at, exact, multiply = self.at, numbers.exact, numbers.multiply
        of, across = exact(at.of), exact(at.of.T.copy())
        a, placed, felt = _moving(whole, at, self.rigid, numbers)
        aside = _aside(a, placed, of, numbers)
        if aside is None:
            return None
        # A device is where it was as the frame began, and the intervals before have moved it since.
        at_once = whole[..., at.out[:, None], at.into]
        forces = numbers.add(multiply(felt, aside), multiply(at_once, of))
        if stands is not None:
            held, along = (numbers.bounded(value_of(one), radius_of(one)) for one in stands)
            aside, forces = numbers.add(multiply(aside, held), along), multiply(forces, held)
        first = np.argmax(at.of, axis=0)
        many = _weights(forces[..., first, :], self.counts, numbers)
        each = many @ at.of.T
        peers = exact(_diagonal(each))
        felt, at_once, forces = (multiply(peers, one) for one in (felt, at_once, forces))
        static = forces[..., first, :]
        b = numbers.subtract(multiply(placed, exact(at.sums)), multiply(aside, across))
        pole = multiply(multiply(of, static), across)
        half = multiply(numbers.add(pole, np.swapaxes(pole, -1, -2)), exact(np.eye(len(at.into)) / 4))
        per_second = at.of * many[..., None, :] / at.seconds[:, None]
        share = numbers.bounded(per_second, 4 * UNIT * per_second)
        damping = multiply(share, dampings) * np.eye(len(at.into))
        units = exact(_diagonal(np.sqrt(at.seconds / each)))

        def scaled(matrix: Matrix) -> Matrix:
            return multiply(multiply(units, matrix), units)

        return Maps(
            a=a,
            b=multiply(b, units),
            c=multiply(units, felt),
            d=scaled(multiply(at_once, exact(at.sums))),
            weight=scaled(numbers.subtract(damping, half)),
            static=static,
            joined=bool((many == self.counts).all()),
        )

    def stands_aside(self, whole: Matrix, free: Floats) -> Standing | None:
        """Return what `maps` takes as given of directions in which devices stand aside, and all else too.

        Parameters
        ----------
        whole
            The closed matrix (2, …) at some point of a box.
        free
            The directions (k, d), at right angles; nobody is pushed along them, whatever the parameters are.
        """
        at = self.at
        a, placed, _ = _moving(whole, at, self.rigid, RADII)
        aside = _aside(a, placed, RADII.exact(at.of), RADII)
        if aside is None:
            return None
        along = free @ free.T
        charge = (len(along) + 2) * UNIT
        held, along = (with_radius(one, (one != 0) * charge) for one in (np.eye(len(along)) - along, along))
        return held, RADII.multiply(aside, along)


def port_loop(found: Openings, loop: Loop, *, option: str) -> tuple[PortLoop, Cut]:
    """Return the map of a loop whose devices are moved from outside, and where it was cut.

    Parameters
    ----------
    found, loop
        The scene, and one of its loops.
    option
        What asked for it.

    Raises
    ------
    ApcError
        E933 too many intervals, or a motion that nothing holds back.
    """
    held = [number for number, _ in found.places(loop)]
    sites = [one.touched for one in found.of(loop)]
    together = found.weighted and len(loop.sites) > 1
    counts = [loop.sites[number].count if together else 1 for number in held]
    if (intervals := sum(len(one.seconds) for one in sites)) > MOST_INTERVALS:
        what = f"devices that differ are sampled and pushed over {intervals:,} intervals of a frame"
        hint = f"fewer peers that differ: {MOST_INTERVALS:,} intervals at most"
        raise ApcError(Mistake("E933", Place(found.scene), f"{option}: {what}", hint=hint))
    closed = close_loop(loop)
    offsets = [closed.offsets[number] for number in held]
    at = _wires(offsets, len(closed.matrix), sites)
    whole = with_radius(closed.matrix, closed.error)
    dampings = RADII.exact(np.array([[float(one.damping)] for one in sites]))
    cut = Cut(at, tuple(counts), np.zeros((len(closed.matrix), 0)))
    maps = cut.maps(whole, dampings, RADII)
    if maps is None:
        rigid = find_rigid_modes(loop).basis
        if rigid.size and not rigid[at.out].any():  # a motion that no device feels
            cut = replace(cut, rigid=rigid)
            maps = cut.maps(whole, dampings, RADII)
    if maps is None:
        what = "with its devices clamped the scene has a motion that nothing holds back"
        hint = "couplers that hold each object to a device"
        raise ApcError(Mistake("E933", Place(found.scene), f"{option}: {what}", hint=hint))
    of_loop = PortLoop(
        name=loop.name,
        multiplicity=loop.multiplicity,
        maps=maps,
        dampings=tuple(one.damping for one in sites),
        starts=at.starts,
        seconds=at.seconds,
        frame_s=closed.frame_s,
    )
    return of_loop, cut


def _diagonal(values: Floats) -> Floats:
    """Return diagonal matrices (…, m, m) of their diagonals (…, m)."""
    return np.asarray(values[..., None] * np.eye(values.shape[-1]))


def _weights(static: Matrix, counts: Sequence[int], numbers: Arithmetic) -> Floats:
    """Return `reciprocal`, of one matrix with its radii, over a cell or not, or of many in floats (k, …)."""
    if numbers is BALLS:  # any numbers will do, as long as they are the same throughout
        middle, off = np.vectorize(lambda one: (float(flint.arb(one).mid()), float(flint.arb(one).rad())))(
            static
        )
        return reciprocal(with_radius(middle, off), counts)
    if numbers is not FLOATS:
        return reciprocal(hull(static), counts)
    if len(counts) == 1:
        return np.array(counts, dtype=np.float64)
    return np.stack([reciprocal(with_radius(one, EVEN * np.abs(one).max()), counts) for one in static])


def reciprocal(static: Matrix, counts: Sequence[int]) -> Floats:
    """Return what the energies of devices are to be multiplied by for their stiffness to be that of springs.

    Parameters
    ----------
    static
        What each kind of device is pushed back by as those of each stand aside (2, k, k), in N/m.
    counts
        How many peers have each, which is what to multiply by where that serves.

    Notes
    -----
    Hands that give back no more than they got, each by itself, do so whatever their energies are multiplied
    by. Where one device feels another more than that feels it, v_g K_gh = v_h K_hg leaves one choice.
    """
    value = value_of(static)
    felt = np.abs(value) > radius_of(static)
    found = np.zeros(len(counts))
    for start, count in enumerate(counts):
        if found[start]:
            continue
        found[start], waiting = count, [start]
        while waiting:
            g = waiting.pop()
            for h in np.flatnonzero(felt[g] & felt[:, g] & (found == 0)).tolist():
                ratio = value[g, h] / value[h, g]
                found[h] = found[g] * ratio if ratio > 0 else counts[h]
                waiting.append(h)
    even = found * counts[0] / found[0] / counts
    return np.array(counts, dtype=np.float64) if np.abs(even - 1).max() <= EVEN else found


def _moving(whole: Matrix, at: _Wires, rigid: Floats, numbers: Arithmetic) -> tuple[Matrix, Matrix, Matrix]:
    """Return what moves by itself, what moves it, and what is felt of it, less rigid motions (n, d)."""
    rest, into, out = at.rest, at.into, at.out
    a, placed, felt = (
        whole[..., rows[:, None], of] for rows, of in ((rest, rest), (rest, into), (out, rest))
    )
    if not rigid.size:
        return a, placed, felt
    to = with_doubt(relative_coordinates(rigid[rest]), numbers)
    less = relative_rows(np.concatenate([a, placed], axis=-1), to, numbers)
    return less[..., to.rest], less[..., len(rest) :], felt[..., to.rest]


def _aside(a: Matrix, placed: Matrix, of: Matrix, numbers: Arithmetic) -> Matrix | None:
    """Return where all else is while devices stand aside by 1, site by site; None where it can't be said."""
    still, pushed = numbers.subtract(numbers.exact(np.eye(a.shape[-1])), a), numbers.multiply(placed, of)
    return numbers.solve(still, pushed)
