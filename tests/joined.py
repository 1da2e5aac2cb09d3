"""Users whose hands may be joined, event by event: a program of its own, which knows no lifting and no modes.

Takes: groups of users, clocks, delays, a graph; hands as matrices of mass, damping and stiffness.
Gives: `Group`, `Table`, whose `text` is the scene for apc; `radii`; `least`.
Guarantees: every sample, force and packet is a row in a list with its time; a frame's map is what playing it
makes of each thing that stands there as it begins.
Does not: use that users are equal.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

MS = Fraction(1, 1000)


@dataclass(frozen=True)
class Group:
    """Equal users, in SI; their forces are computed at ticks of `clock`."""

    name: str
    count: int
    device: float
    damping: float
    contact: float
    backward: float
    late: Fraction
    clock: str
    pull: float
    pull_late: Fraction


@dataclass(frozen=True)
class Table:
    """A scene; `clocks` are periods and phases, `late` is how old packets are at least."""

    groups: tuple[Group, ...]
    clocks: dict[str, tuple[Fraction, Fraction]]
    late: Fraction
    cube: float
    drag: float
    kind: str = "AveragePosition"
    graph: str = "complete"
    sites: tuple[Group, ...] = field(init=False)

    def __post_init__(self) -> None:
        """List the users."""
        sites = tuple(group for group in self.groups for _ in range(group.count))
        object.__setattr__(self, "sites", sites)

    @property
    def frame(self) -> Fraction:
        """After what time all clocks come back."""
        used = [self.clocks[name][0] for name in {"network"} | {group.clock for group in self.groups}]
        below = math.lcm(*(one.denominator for one in used))
        return Fraction(math.lcm(*(int(one * below) for one in used)), below)

    def ticks(self, clock: str) -> Iterator[Fraction]:
        """Yield when a clock ticks in a frame."""
        period, now = self.clocks[clock]
        while now < self.frame:
            yield now
            now += period

    @property
    def instants(self) -> list[Fraction]:
        """When anything happens in a frame."""
        found = {Fraction(0), *self.ticks("network")}
        for group in self.groups:
            for now in self.ticks(group.clock):
                found |= {now, (now + group.late) % self.frame, (now + group.pull_late) % self.frame}
        return sorted(found)

    def heard(self, user: int) -> list[int]:
        """Return whom a user hears."""
        n = len(self.sites)
        if self.graph == "ring":
            return sorted({(user - 1) % n, (user + 1) % n})
        return [other for other in range(n) if other != user]

    @property
    def text(self) -> str:
        """The scene for apc; `BackwardSpring` is in `LIBRARY`."""
        clocks = ", ".join(
            f"{name}: {{period: {_ms(p)}, phase: {_ms(f)}}}" for name, (p, f) in self.clocks.items()
        )
        peers = ""
        for one in self.groups:
            own = {
                "device.mass": f"{one.device!r} kg",
                "device.damping": f"{one.damping!r} N*s/m",
                "contact.stiffness": f"{one.contact!r} N/m",
                "contact.damping": f"{one.backward!r} N*s/m",
                "contact.clock": one.clock,
                "contact.period": _ms(self.clocks[one.clock][0]),
                "contact.delay": _ms(one.late),
                "coordination.stiffness": f"{one.pull!r} N/m",
                "coordination.clock": one.clock,
                "coordination.delay": _ms(one.pull_late),
            }
            listed = ", ".join(f"{name}: {value}" for name, value in own.items())
            peers += f"  {one.name}: {{count: {one.count}, set: {{{listed}}}}}\n"
        clock = self.groups[0].clock
        return (
            f"topology: joined\nclocks: {{{clocks}}}\npeers:\n{peers}masses:\n"
            "  device: {mass: 1 kg, damping: 1 N*s/m}\n"
            f"  cube: {{mass: {self.cube!r} kg, damping: {self.drag!r} N*s/m, shared: true}}\n"
            "couplers:\n  contact: {type: BackwardSpring, a: device, b: cube, stiffness: 1 N/m, "
            f"period: 1 ms, clock: {clock}}}\n"
            f"  coordination: {{type: {self.kind}, object: cube, stiffness: 1 N/m, "
            f"clock: {clock}, link: lan}}\n"
            f"links: {{lan: {{clock: network, delay: {_ms(self.late)}, graph: {self.graph}}}}}\n"
        )


LIBRARY = """\
component: BackwardSpring
about: Spring and damper between two flanges, from samples of positions; velocity by backward difference.
source: a test
connectors: {a: Flange, b: Flange}
parameters:
  stiffness: {unit: N/m, min: 0, about: force per displacement}
  damping:   {unit: N*s/m, min: 0, default: 0 N*s/m, about: force per relative velocity}
  clock: clock
  period:    {unit: s, above: 0, about: that of the clock}
  delay:     {unit: s, min: 0, default: 0 s, about: computational delay from the sample to the force}
variables:
  x: {unit: m, start: 0 m, about: how far the flanges are apart at a tick}
  f: {unit: N, about: force computed at a tick}
equations:
  - x = sample(a.x) - sample(b.x)
  - f = stiffness*x + damping*(x - previous(x))/period
  - a.f = hold(f, delay)
  - b.f = -a.f
"""


def _ms(time: Fraction) -> str:
    return f"{float(1000 * time):.12g} ms"


@dataclass(frozen=True)
class Hands:
    """What holds the devices, and masses of its own behind them: M, D and K (n, n), the devices first."""

    mass: Floats
    damping: Floats
    stiffness: Floats


Key = tuple[str, int, Fraction]


class _Play:
    """What stands at an instant: rows over whatever it is asked to be followed for.

    Of each user i: `q[at[i]]` is the device's position, `q[to[i]]` the copy's; `acting` and `coming` are the
    forces 2i of the contact and 2i + 1 of the network, `sent` the packets, `before` the sample before.
    """

    def __init__(self, table: Table, hands: Hands | None) -> None:
        self.table = table
        n = len(table.sites)
        if hands is None:  # devices are where they are moved to
            self.a = np.zeros((3 * n, 3 * n))
            self.b = np.zeros((3 * n, 2 * n))
            self.at, self.to = [3 * i for i in range(n)], [3 * i + 1 for i in range(n)]
        else:
            self._held(hands)
        for i, x in enumerate(self.to):
            copy = table.cube / n
            self.a[x, x + 1], self.a[x + 1, x + 1] = 1, -table.drag / copy
            self.b[x + 1, [2 * i, 2 * i + 1]] = 1 / copy, -1 / copy
        self.known: dict[Fraction, Matrix] = {}
        self.begin({}, 1)

    def _held(self, hands: Hands) -> None:
        """Set the equations of devices that hands hold."""
        n, many = len(self.table.sites), len(hands.mass)
        own = [*range(n), *([n] * (many - n))]
        masses = [*(one.device for one in self.table.sites), 0.0]
        dampings = [*(one.damping for one in self.table.sites), 0.0]
        inverse = np.linalg.inv(hands.mass + np.diag([masses[one] for one in own]))
        self.a = np.zeros((2 * many + 2 * n,) * 2)
        self.b = np.zeros((len(self.a), 2 * n))
        x = 2 * np.arange(many)
        self.a[x, x + 1] = 1
        self.a[np.ix_(x + 1, x)] = -inverse @ hands.stiffness
        self.a[np.ix_(x + 1, x + 1)] = -inverse @ (hands.damping + np.diag([dampings[one] for one in own]))
        self.b[np.ix_(x + 1, 2 * np.arange(n))] = -inverse[:, :n]
        self.at, self.to = x[:n].tolist(), [2 * many + 2 * i for i in range(n)]

    def begin(self, rows: dict[Key, Floats], columns: int) -> None:
        """Set what stands as a frame begins at 0; what isn't said is 0."""
        n = len(self.table.sites)

        def listed(what: str, many: int) -> Floats:
            zero = np.zeros(columns)
            return np.array([rows.get((what, place, Fraction(0)), zero) for place in range(many)])

        def dated(what: str, place: int) -> list[tuple[Fraction, Floats]]:
            return [(when, row) for (name, of, when), row in rows.items() if (name, of) == (what, place)]

        self.q, self.acting = listed("q", len(self.a)), listed("acting", 2 * n)
        self.before = listed("before", n)
        self.coming = [dated("coming", force) for force in range(2 * n)]
        self.sent = [dated("sent", user) for user in range(n)]

    def standing(self, now: Fraction) -> dict[Key, Floats]:
        """Return what stands as a frame begins, dated from then."""
        zero = Fraction(0)
        rows = {("q", place, zero): row for place, row in enumerate(self.q)}
        rows |= {("acting", place, zero): row for place, row in enumerate(self.acting)}
        rows |= {("before", place, zero): row for place, row in enumerate(self.before)}
        for force, coming in enumerate(self.coming):
            rows |= {("coming", force, when - now): row for when, row in coming}
        for user, sent in enumerate(self.sent):
            newest = max((when for when, _ in sent if when + self.table.late <= now), default=zero)
            rows |= {("sent", user, when - now): row for when, row in sent if when >= newest}
        return rows

    def happen(self, now: Fraction) -> None:
        """Do what happens at an instant: send, sample and compute, switch."""
        table = self.table

        def ticks(clock: str) -> bool:
            period, phase = table.clocks[clock]
            return (now - phase) % period == 0

        if ticks("network"):
            for user, x in enumerate(self.to):
                self.sent[user].append((now, self.q[x].copy()))
        for user, one in enumerate(table.sites):
            if not ticks(one.clock):
                continue
            apart = self.q[self.at[user]] - self.q[self.to[user]]
            rate = (apart - self.before[user]) / float(table.clocks[one.clock][0])
            self.before[user] = apart
            self.coming[2 * user].append((now + one.late, one.contact * apart + one.backward * rate))
            others = table.heard(user)
            share = one.pull if table.kind == "FullMesh" else one.pull / len(others)
            pull = sum(share * (self.q[self.to[user]] - self._newest(other, now)) for other in others)
            self.coming[2 * user + 1].append((now + one.pull_late, np.asarray(pull)))
        for force, coming in enumerate(self.coming):
            for when, row in coming:
                if when <= now:
                    self.acting[force] = row
            self.coming[force] = [(when, row) for when, row in coming if when > now]

    def _newest(self, user: int, now: Fraction) -> Floats:
        """Return the newest position that has arrived."""
        found = [row for when, row in self.sent[user] if when + self.table.late <= now]
        return found[-1] if found else np.zeros(self.q.shape[1])

    def move(self, lasting: Fraction) -> None:
        """Let time go by."""
        if lasting not in self.known:
            n, holds = self.b.shape
            whole = np.block([[self.a, self.b], [np.zeros((holds, n + holds))]])
            self.known[lasting] = expm(whole * float(lasting))[:n]
        self.q = self.known[lasting] @ np.concatenate([self.q, self.acting])

    def keys(self) -> list[Key]:
        """Return what stands as a frame begins, once all has begun to happen."""
        frame = self.table.frame
        longest = max(self.table.late, *(max(one.late, one.pull_late) for one in self.table.groups))
        now = -(longest // frame + 3) * frame
        self.begin({}, 1)
        while now < 0:
            for instant in self.table.instants:
                self.happen(now + instant)
            now += frame
        return list(self.standing(Fraction(0)))


def radii(table: Table, hands: Hands) -> Floats:
    """Return the absolute eigenvalues of a frame, the largest last."""
    play = _Play(table, hands)
    keys = play.keys()
    play.begin(dict(zip(keys, np.eye(len(keys)), strict=True)), len(keys))
    instants = table.instants
    for now, end in zip(instants, [*instants[1:], table.frame], strict=True):
        play.happen(now)
        play.move(end - now)
    after = play.standing(table.frame)
    return np.sort(np.abs(np.linalg.eigvals(np.array([after[key] for key in keys]))))


@dataclass(frozen=True)
class Moved:
    """The map from how far hands move devices in each interval to the forces there, and dampers."""

    a: Floats
    b: Floats
    c: Floats
    d: Floats
    seconds: Floats
    dampings: Floats
    clamped: float

    def least(self, angle: float) -> float:
        """Return the least eigenvalue of He H + diag(b/τ) in N·s/m at an angle."""
        states = np.linalg.solve(np.exp(1j * angle) * np.eye(len(self.a)) - self.a, self.b + 0j)
        given = self.c @ states + self.d
        root = np.sqrt(self.seconds)
        weighed = root[:, None] * (given + given.conj().T) / 2 * root + np.diag(self.dampings)
        return float(np.linalg.eigvalsh(weighed)[0])


def moved(table: Table) -> Moved:
    """Return what pushes devices back while hands move them, all users at once."""
    play = _Play(table, None)
    keys = play.keys()
    own: list[tuple[int, Fraction]] = []
    ends: list[Fraction] = []
    for user, one in enumerate(table.sites):
        ticks = list(table.ticks(one.clock))
        at = sorted({Fraction(0), *ticks, *((now + one.late) % table.frame for now in ticks)})
        own += [(user, now) for now in at]
        ends += [*at[1:], table.frame]
    size, inputs = len(keys), len(own)
    play.begin(dict(zip(keys, np.eye(size, size + inputs), strict=True)), size + inputs)
    forces = np.zeros((inputs, size + inputs))
    instants = table.instants
    for now, end in zip(instants, [*instants[1:], table.frame], strict=True):
        play.happen(now)
        for place, (user, begins) in enumerate(own):
            if begins == now:
                forces[place] = play.acting[2 * user]
        play.move(end - now)
        for place, (user, _) in enumerate(own):
            if ends[place] == end:
                play.q[play.at[user], size + place] += 1
    after = play.standing(table.frame)
    whole = np.array([after[key] for key in keys])
    rest = [place for place, (what, of, _) in enumerate(keys) if what != "q" or of not in play.at]
    return Moved(
        a=whole[:, :size],
        b=whole[:, size:],
        c=forces[:, :size],
        d=forces[:, size:],
        seconds=np.array([float(end - begins) for (_, begins), end in zip(own, ends, strict=True)]),
        dampings=np.array([table.sites[user].damping for user, _ in own]),
        clamped=float(np.abs(np.linalg.eigvals(whole[np.ix_(rest, rest)])).max()),
    )
