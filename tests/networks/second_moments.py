"""Second moments over a lossy network, event by event and draw by draw: none of `apc.moments`.

Takes: a `CompiledSystem` and the numbers of its links' channels.
Gives: `Law`, `second_moment_radius`, `size_of`, `rms_error`.
Guarantees: on `fifty_digits.events`, which shares no map, no closing and no schedule with what it checks.
Does not: use any symmetry, or serve more channels than `MOST` numbers hold.

The state holds every peer, what it computed and sent lately, and for each way from peer to peer the packet
that counts. Luck is a Markov chain of each way: whether it is bad, whether its last packet is missed, which
of the packets under way has arrived. Second moments X of every combination of these move from event to event,
either by X → A X Aᵀ or, of one way, X_k → Σ P(k → k') J X Jᵀ: never by a formula for a whole frame.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import scipy.sparse.linalg
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.frame.parameters import resolve
from tests.fifty_digits.events import Happening, Peer, build_peers, ticks_between
from tests.fifty_digits.truth import _common_whom, _everybody

Floats = NDArray[np.float64]

# Numbers of all second moments: some seconds.
MOST = 400_000

# What stands still in every draw, in floats.
STANDING = 1e-9


@dataclass(frozen=True, slots=True)
class Law:
    """The numbers of a link's packets: netem's `gemodel`, and a uniform jitter in seconds."""

    p: float = 0.0
    r: float = 1.0
    bad_loss: float = 1.0
    good_loss: float = 0.0
    jitter: Fraction = Fraction(0)
    zero: bool = False

    @property
    def independent(self) -> bool:
        return abs(self.p + self.r - 1) < 1e-12 or self.p == 0

    @property
    def loss(self) -> float:
        bad = self.p / (self.p + self.r)
        return bad * self.bad_loss + (1 - bad) * self.good_loss

    def arrived(self, delay: Fraction, elapsed: Fraction) -> float:
        """Return how likely a packet has arrived after so many seconds."""
        if not self.jitter:
            return (1 - self.loss) * (elapsed >= delay >= 0 <= elapsed)
        share = float((elapsed - delay + self.jitter) / (2 * self.jitter))
        return (1 - self.loss) * min(max(share, 0.0), 1.0) * (elapsed >= 0)


@dataclass(frozen=True, slots=True)
class _Way:
    """A way from peer to peer: its chain's states, and what they say."""

    link: str
    receiver: int
    sender: int
    law: Law
    delay: Fraction
    period: Fraction
    depth: int  # packets under way
    states: int
    register: slice  # of the whole state
    queue: slice


# A step of one way's chain: (from, to, probability, place in the queue of the packet that counts now, None
# for the one that counted before).
Step = tuple[int, int, float, int | None]


def second_moment_radius(system: CompiledSystem, laws: Mapping[str, Law], *, several: int = 2) -> float:
    """Return what second moments grow by in a frame, motions left out that no draw moves; NaN if not found.

    An iteration may find the smaller of two eigenvalues near each other, the less so the more are looked for.
    """
    played = _Played(system, laws)
    n, project = played.size, played.without_standing()
    shape = tuple(way.states for way in played.ways)

    def step(flat: Floats) -> Floats:
        moments = flat.reshape(*shape, n, n)
        for act in played.acts:
            moments = act(moments)
        return np.asarray(project @ moments @ project.T).reshape(-1)

    start = np.broadcast_to(project @ project.T, (*shape, n, n)).reshape(-1)
    for _ in range(3):  # into what frames can reach at all
        start = step(start)
        start = start / np.abs(start).max()
    operator = scipy.sparse.linalg.LinearOperator((start.size, start.size), matvec=step, dtype=np.float64)
    own = {"which": "LM", "v0": start, "ncv": min(30 + 10 * several, start.size - 1), "tol": 1e-12}
    for count in (several, 1):
        try:
            values = scipy.sparse.linalg.eigs(operator, count, maxiter=400, return_eigenvectors=False, **own)
        except scipy.sparse.linalg.ArpackNoConvergence as slow:
            values = slow.eigenvalues
        if len(values):
            return float(np.abs(values).max())
    return math.nan


def size_of(system: CompiledSystem, laws: Mapping[str, Law]) -> int:
    """Return how many numbers of second moments there are."""
    laid = _Played.__new__(_Played)
    laid.lay_out(system, laws)
    return math.prod(way.states for way in laid.ways) * laid.size**2


def rms_error(system: CompiledSystem, laws: Mapping[str, Law]) -> float:
    """Return the largest root mean square distance (m) of a `cube` from the mean of others as frames begin.

    Each `device` is pushed by a force of variance 1 N², drawn anew at every tick.
    """
    played = _Played(system, laws, pushed=True)
    project, places = played.without_standing(), [site.start for site in played.copies]
    moments = np.zeros((*(way.states for way in played.ways), played.size, played.size))
    moments[..., played.one, played.one] = 1 / math.prod(way.states for way in played.ways)
    forms = np.zeros((len(places), played.size))
    forms[:, places] = -1 / (len(places) - 1)
    forms[range(len(places)), places] = 1.0
    before, found = 0.0, 1.0
    while abs(found - before) > 1e-13 * found:
        before = found
        for act in played.acts:
            moments = act(moments)
        moments = project @ moments @ project.T
        total = moments.reshape(-1, played.size, played.size).sum(axis=0)
        found = float(np.einsum("pi,ij,pj->p", forms, total, forms).max())
    return math.sqrt(found)


class _Played:
    """The events of a frame, each as what it does to second moments.

    If `pushed`, the state ends with each peer's push, which `redrawn` draws anew, and the number 1, whose
    second moments say how likely each combination of luck is.
    """

    def __init__(self, system: CompiledSystem, laws: Mapping[str, Law], *, pushed: bool = False) -> None:
        self.lay_out(system, laws, pushed=pushed)
        self.acts: list[Callable[[Floats], Floats]] = []
        self._frame()

    def lay_out(self, system: CompiledSystem, laws: Mapping[str, Law], *, pushed: bool = False) -> None:
        """Say where in the state everything is."""
        whole = _everybody(system)
        self.sites = build_peers(system, whole.peers, whole.groups, linear=True)
        self.scene = Happening(system, self.sites, _common_whom(self.sites, whole))
        scene, first = self.scene, 0
        self.x: list[slice] = []
        self.computed: list[list[list[slice]]] = []  # by peer and clock, the newest first
        self.packets: dict[tuple[int, str], list[slice]] = {}

        def places(count: int) -> slice:
            nonlocal first
            first += count
            return slice(first - count, first)

        for i, site in enumerate(self.sites):
            self.x.append(places(len(site.kind.states)))
            self.computed.append(
                [
                    [places(len(clock.outputs)) for _ in range(back)]
                    for clock, back in zip(site.kind.clocks, site.back, strict=True)
                ]
            )
            for send in site.kind.sends:
                period = scene.clocks[scene.clock_of[send.link]][1]
                delay = max(scene.delay[send.link, site.group, other.group] for other in self.sites)
                late = laws.get(send.link, Law()).jitter
                # One more: what arrives between two ticks is looked at with the later of them.
                slow = max(one[1] for one in scene.clocks.values())
                depth = math.ceil((delay + late + slow) / period) + 1
                self.packets[i, send.link] = [places(len(send.channels)) for _ in range(depth)]
        self.ways: list[_Way] = []
        for i, site in enumerate(self.sites):
            for link in sorted({receive.link for clock in site.kind.clocks for receive in clock.receives}):
                operators = {r.operator for c in site.kind.clocks for r in c.receives if r.link == link}
                for j in sorted({j for operator in operators for j, _ in scene.whom(link, operator, i)}):
                    queue, law = self.packets[j, link], laws.get(link, Law())
                    delay = scene.delay[link, self.sites[j].group, site.group]
                    width = queue[0].stop - queue[0].start
                    self.ways.append(
                        _Way(
                            *(link, i, j, law, delay, scene.clocks[scene.clock_of[link]][1], len(queue)),
                            states=len(queue) + 1
                            if law.jitter
                            else (1 if law.independent else 2) * (1 + law.zero),
                            register=places(width),
                            queue=slice(queue[0].start, queue[-1].stop),
                        )
                    )
        self.pushes = [places(1).start for _ in self.sites if pushed]
        self.one = places(int(pushed)).start
        self.size = first
        self.shares, numbers = [], resolve(system).parameters
        for site in self.sites:
            mass = (
                float(numbers[site.group][0][list(site.kind.parameters).index("device.mass")])
                if pushed
                else 1.0
            )
            self.shares.append([pushed * (state.name == "device.v") / mass for state in site.kind.states])
        self.copies = [
            slice(x.start + [state.name for state in site.kind.states].index("cube.x"), None)
            for x, site in zip(self.x, self.sites, strict=True)
            if pushed
        ]

    def without_standing(self) -> Floats:
        """Return the projection that takes off what stands still in every draw, and what nobody reads."""
        generator = np.random.default_rng(0)
        rows = [self._drawn(generator) - np.eye(self.size) for _ in range(12)]
        rows += [
            np.eye(self.size)[[*self.pushes, *range(self.one, self.size)]]
        ]  # these stand for what changes
        _, values, vectors = np.linalg.svd(np.concatenate(rows))
        unread = np.eye(self.size)[[place for place in self._registers if not self._read[place]]]
        gone, _ = np.linalg.qr(np.concatenate([unread, vectors[values < STANDING * values[0]]]).T)
        return np.eye(self.size) - gone @ gone.T

    @property
    def _registers(self) -> list[int]:
        return [place for way in self.ways for place in range(way.register.start, way.register.stop)]

    @property
    def _read(self) -> NDArray[np.bool_]:
        """Say of each number whether another follows from it: what is held and never read lasts."""
        found = np.zeros(self.size, dtype=bool)
        for kind, *what in self.record:
            for modes in np.ndindex(*(way.states for way in self.ways)) if kind == "map" else ():
                found |= (what[0](modes) - np.eye(self.size)).any(axis=0)
        return found

    def _drawn(self, generator: np.random.Generator) -> Floats:
        """Return the matrix of a frame, drawn at random."""
        total, modes = np.eye(self.size), [int(generator.integers(way.states)) for way in self.ways]
        for kind, *what in self.record:
            if kind == "map":
                total = what[0](modes) @ total
            else:
                place, steps = what
                own = [step for step in steps if step[0] == modes[place] and step[2] > 0]
                _, modes[place], _, taken = own[int(generator.integers(len(own)))]
                total = self._taken(place, taken) @ total
        return total

    def _taken(self, place: int, taken: int | None) -> Floats:
        """Return what a packet does that counts from now on."""
        found = np.eye(self.size)
        if taken is not None:
            way = self.ways[place]
            source = self.packets[way.sender, way.link][taken]
            found[way.register] = 0.0
            found[way.register, source] = np.eye(source.stop - source.start)
        return found

    def _flush(self) -> None:
        """Add what happened since luck was last drawn: one map for each state of the chains or for all."""
        whole, alike = self.pending, self.pending.ndim == 2
        self.pending = np.eye(self.size)
        self.record.append(("map", lambda modes: whole if alike else whole[tuple(modes)]))
        self.acts.append(lambda moments: whole @ moments @ np.swapaxes(whole, -1, -2))

    def _luck(self, place: int, steps: Sequence[Step]) -> None:
        """Add a step of one way's chain."""
        if all(before == after and taken is None for before, after, chance, taken in steps if chance):
            return
        self._flush()
        self.record.append(("luck", place, steps))
        way = self.ways[place]

        def act(moments: Floats) -> Floats:
            moved = np.zeros_like(moments)
            into, out = np.moveaxis(moved, place, 0), np.moveaxis(moments, place, 0)
            for before, after, chance, taken in steps:
                if not chance:
                    continue
                one = out[before]
                if taken is not None:
                    source = self.packets[way.sender, way.link][taken]
                    one = one.copy()
                    one[..., way.register, :] = one[..., source, :]
                    one[..., :, way.register] = one[..., :, source]
                into[after] += chance * one
            return moved

        self.acts.append(act)

    def _frame(self) -> None:
        scene = self.scene
        self.record: list[tuple] = []
        times = scene.instants(Fraction(0), scene.frame)
        ticks = sorted(
            {
                one
                for site in self.sites
                for clock in site.kind.clocks
                for one in ticks_between(*scene.clocks[clock.clock], Fraction(0), scene.frame)
            }
        )
        self.pending: Floats = np.eye(self.size)
        zero = any(way.law.zero and not way.law.jitter for way in self.ways)
        shape = [way.states for way in self.ways]
        for now, following in itertools.pairwise(times):
            for i, site in enumerate(self.sites):
                for send, rule in zip(site.kind.sends, site.sends, strict=True):
                    if not scene._ticks_now(scene.clock_of[send.link], now):
                        continue
                    self.pending = self._sent(i, send.link, rule, now) @ self.pending
                    for place, way in enumerate(self.ways):
                        if (way.link, way.sender) == (send.link, i) and way.law.jitter:
                            older = [(k, min(k + 1, way.depth), 1.0, None) for k in range(way.depth + 1)]
                            self._luck(place, older)
            if now in ticks:
                earlier = [one for one in ticks if one < now]
                before = earlier[-1] if earlier else ticks[-1] - scene.frame
                for place, way in enumerate(self.ways):
                    self._delivered(place, way, before, now)
                if zero:
                    every = np.array([self._ticked(now, modes) for modes in np.ndindex(*shape)])
                    self.pending = every.reshape(*shape, self.size, self.size) @ self.pending
                else:
                    self.pending = self._ticked(now, [0] * len(self.ways)) @ self.pending
                self._flush()
                self.acts.append(self.redrawn)
            self.pending = self._moved(now, following) @ self.pending
        self._flush()

    def redrawn(self, moments: Floats) -> Floats:
        """Let every push be another."""
        moments = moments.copy()
        moments[..., self.pushes, :] = moments[..., :, self.pushes] = 0.0
        for place in self.pushes:
            moments[..., place, place] = moments[..., self.one, self.one]
        return moments

    def _delivered(self, place: int, way: _Way, before: Fraction, now: Fraction) -> None:
        """Let what has arrived since the tick before count."""
        phase, period = self.scene.clocks[self.scene.clock_of[way.link]]
        newest = phase + (now - phase) // period * period
        sent = [newest - k * period for k in range(way.depth)]  # by place in the queue
        law = way.law
        if law.jitter:
            chance = []
            for one in sent:
                was, now_is = law.arrived(way.delay, before - one), law.arrived(way.delay, now - one)
                chance.append(0.0 if now_is <= was else (now_is - was) / (1 - was))
            steps: list[Step] = []
            for state in range(way.depth + 1):  # the place of the newest that counts
                left = 1.0
                for k in range(min(state, way.depth)):
                    steps.append((state, k, left * chance[k], k))
                    left *= 1 - chance[k]
                steps.append((state, state, left, None))
            self._luck(place, steps)
            return
        for k in range(way.depth - 1, -1, -1):
            if not before < sent[k] + way.delay <= now:
                continue
            flags = 1 + law.zero
            moods = way.states // flags
            steps = []
            for mood in range(moods):
                loss = law.loss if moods == 1 else (law.bad_loss if mood else law.good_loss)
                turn = 1.0 if moods == 1 else (law.r if mood else law.p)
                for flag in range(flags):
                    state = mood * flags + flag
                    missed = k if law.zero else None  # kept though nobody reads it: so it stays with the rest
                    for lost, chance in ((False, 1 - loss), (True, loss)):
                        for after in range(moods):
                            share = 1.0 if moods == 1 else (turn if after != mood else 1 - turn)
                            to = after * flags + (int(lost) if law.zero else 0)
                            steps.append((state, to, chance * share, missed if lost else k))
            self._luck(place, steps)

    def _sent(self, i: int, link: str, rule: Callable, now: Fraction) -> Floats:
        queue = self.packets[i, link]
        found = np.eye(self.size)
        for newer, older in itertools.pairwise(queue):
            found[older] = np.eye(self.size)[newer]
        found[queue[0]] = self._own(i, rule, now)
        return found

    def _own(self, i: int, rule: Callable, now: Fraction) -> Floats:
        """Return what a peer would send, over the state."""
        arguments = [np.eye(self.size)[self.x[i]], self._held(i, now, before=True)]
        return _applied(rule, now, arguments, self.size)

    def _held(self, i: int, now: Fraction, *, before: bool) -> Floats:
        site = self.sites[i]
        found: list[Floats] = []
        place = {clock.clock: number for number, clock in enumerate(site.kind.clocks)}
        for hold, delay in zip(site.kind.holds, site.delays, strict=True):
            phase, period = self.scene.clocks[hold.clock]
            # The newest that acts; ticks at `now` itself are in the list only after it.
            last = phase + (now - phase) // period * period
            if before and last == now:
                last -= period
            for number, one in enumerate(self.computed[i][place[hold.clock]]):
                time = last - number * period
                if time + delay < now or (time + delay == now and not before):
                    found.append(np.eye(self.size)[one.start + hold.output])
                    break
            else:
                raise AssertionError("a force acts that is not kept")
        return np.array(found).reshape(len(found), self.size)

    def _ticked(self, now: Fraction, modes: Sequence[int]) -> Floats:
        found = np.eye(self.size)
        for i, site in enumerate(self.sites):
            for place, clock in enumerate(site.kind.clocks):
                if not self.scene._ticks_now(clock.clock, now):
                    continue
                listed = self.computed[i][place]
                heard = np.array([self._heard(i, one, now, modes) for one in clock.receives])
                memory = np.array([np.eye(self.size)[listed[0].start + row] for row in clock.memories])
                arguments = [
                    np.eye(self.size)[self.x[i]],
                    self._held(i, now, before=True),
                    memory.reshape(-1, self.size),
                    heard.reshape(-1, self.size),
                ]
                for newer, older in itertools.pairwise(listed):
                    found[older] = np.eye(self.size)[newer]
                found[listed[0]] = _applied(site.ticks[place], now, arguments, self.size)
        return found

    def _heard(self, i: int, receive, now: Fraction, modes: Sequence[int]) -> Floats:
        found = np.zeros(self.size)
        for j, weight in self.scene.whom(receive.link, receive.operator, i):
            place, way = next(
                (place, way)
                for place, way in enumerate(self.ways)
                if (way.link, way.receiver, way.sender) == (receive.link, i, j)
            )
            if way.law.zero and not way.law.jitter and modes[place] % 2:
                number = next(
                    n for n, send in enumerate(self.sites[i].kind.sends) if send.link == receive.link
                )
                found += float(weight) * self._own(i, self.sites[i].sends[number], now)[receive.channel]
            else:
                found[way.register.start + receive.channel] += float(weight)
        return found

    def _moved(self, now: Fraction, following: Fraction) -> Floats:
        found = np.eye(self.size)
        for i, site in enumerate(self.sites):
            held = self._held(i, now, before=False)
            push = np.eye(self.size)[self.pushes[i : i + 1]]
            found[self.x[i]] = _flow(site, following - now, self.shares[i])[:, : len(push) - 1 or None] @ (
                np.concatenate([np.eye(self.size)[self.x[i]], held, push])
            )
        return found


def _applied(rule: Callable, now: Fraction, arguments: Sequence[Floats], size: int) -> Floats:
    """Return a linear rule of rows (n_k, size), as rows."""
    sizes = [len(one) for one in arguments]
    total = np.concatenate([np.asarray(one).reshape(-1, size) for one in arguments])
    columns = []
    for place in range(sum(sizes)):
        unit = [float(place == k) for k in range(sum(sizes))]
        parts, first = [], 0
        for count in sizes:
            parts.append(unit[first : first + count])
            first += count
        columns.append([float(one) for one in rule(now, *parts)])
    return np.array(columns).T @ total


def _flow(site: Peer, duration: Fraction, push: Sequence[float]) -> Floats:
    """Return [e^At, ∫e^As B, ∫e^As b] (n_x, n_x + n_u + 1), b being what a push does."""
    n = len(site.kind.states)
    rate = np.array([[float(one.p) / float(one.q) for one in row] for row in site.rate.tolist()])
    rate[:n, -1] = push
    return np.asarray(scipy.linalg.expm(rate * float(duration)))[:n]
