"""What a scene does to fifty digits: all peers, event by event, in ball arithmetic.

Takes: a `CompiledSystem`.
Gives: `Classes`, `classes_of`; `frame_matrices`, `eigenvalues`, `Truth`, `spectral_truth`; `exact_course`.
Guarantees: shares the compiled functions with the analysis and the simulation and nothing else: no Jacobian,
schedule, lifted map or mode of theirs; digits that are not certain are not given.
Does not: serve what is not linear between events, or draw lots: it says why.

Every computed value and every packet is kept with its time; whoever needs one takes the newest that counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import casadi
import flint
import numpy as np

from apc.compiler.compiled import CompiledSystem, Kind
from apc.runtime.balls import precision, rational_ball
from apc.runtime.exact import evaluate_exact, is_rational
from apc.runtime.exchange import arcs
from apc.runtime.parameters import resolve

Number = Any  # flint.arb, or an exact 0 or 1

# What is asked of a reference, relative to the largest: far beyond what floats can be wrong by.
DIGITS = 50

# Bits tried in turn until the digits are certain.
PRECISIONS = (512, 1024, 2048, 4096)

# An eigenvalue so near to 1 is 1: a motion that nothing hinders. A pair or a triple of them that belongs to
# one chain is split by the third root of the precision at worst, 1e-51 at 512 bits; what damping of 1e-12
# leaves differs by 1e-14 or more.
RIGID = 1e-30

# Eigenvalues of larger matrices take minutes at this precision.
MOST_STATES = 110


@dataclass(frozen=True, slots=True)
class Classes:
    """Peers that can change places: `counts` (K,), a representative of each (its number), its group.

    `weights[link][c][d]` is what a peer of class c multiplies the packets of each peer of class d (other than
    itself) by.
    """

    counts: tuple[int, ...]
    peers: tuple[int, ...]
    groups: tuple[int, ...]
    weights: Mapping[str, tuple[tuple[Fraction, ...], ...]]


def classes_of(system: CompiledSystem) -> Classes:
    """Find the peers that can change places: equal ones on complete graphs and stars, else none."""
    rows = resolve(system).rows
    shapes = {link.graph.shape for link in system.links}
    apart = not shapes <= {"complete", "star"}
    counts: dict[tuple[int, ...], int] = {}
    first: dict[tuple[int, ...], int] = {}
    number = 0
    for place, group in enumerate(system.groups):
        own = rows[place]
        if not own.strides[0] and not apart and not (number == 0 and "star" in shapes):
            counts[place, 0, 0], first[place, 0, 0] = group.count, number
            number += group.count
            continue
        for row in own.tolist():
            alone = number + 1 if apart or (number == 0 and "star" in shapes) else 0
            key = (place, row, alone)
            counts[key] = counts.get(key, 0) + 1
            first.setdefault(key, number)
            number += 1
    keys = list(counts)
    weights = {}
    for link in system.links:
        if link.graph.shape == "complete":
            table = [[Fraction(1)] * len(keys) for _ in keys]
        elif link.graph.shape == "star" and not apart:
            table = [[Fraction((first[c] == 0) != (first[d] == 0)) for d in keys] for c in keys]
        else:
            table = [[Fraction(0)] * len(keys) for _ in keys]
            for (sender, receiver), weight in zip(*arcs(link.graph, number), strict=True):
                table[receiver][sender] += Fraction(float(weight))
        weights[link.name] = tuple(tuple(row) for row in table)
    return Classes(
        tuple(counts.values()), tuple(first[key] for key in keys), tuple(key[0] for key in keys), weights
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Site:
    """One peer: its functions over exact numbers, and what is needed of the past.

    `ticks` and `sends` give a list of numbers of (x, u, m, r) and of (x, u); `rate` is [A B c] (n_x, n_x +
    n_u + 1), exact. `back` counts the ticks kept of each clock, `sent_back` the packets of each link.
    """

    kind: Kind
    group: int
    ticks: tuple[Callable[..., list[Number]], ...]
    sends: tuple[Callable[..., list[Number]], ...]
    rate: Any  # flint.fmpq_mat, square
    delays: tuple[Fraction, ...]
    back: tuple[int, ...]
    sent_back: tuple[int, ...]
    start_x: tuple[Fraction, ...]
    start_m: tuple[tuple[Fraction, ...], ...]
    steps: dict[Fraction, Any] = field(default_factory=dict)  # exponentials at the present precision

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its part of the state at the start of a frame."""
        found = [state.name for state in self.kind.states]
        for clock, count in zip(self.kind.clocks, self.back, strict=True):
            found += [f"{name}(−{k + 1})" for k in range(count) for name in clock.outputs]
        for send, count in zip(self.kind.sends, self.sent_back, strict=True):
            found += [f"{name}(−{k + 1})" for k in range(count) for name in send.channels]
        return tuple(found)


# Who hears whom over a link with an operator, as (sender, weight): place of the peer among those played.
_Whom = Callable[[str, str, int], Sequence[tuple[int, Fraction]]]


@dataclass(slots=True)
class _Play:
    """The peers in motion: continuous states, and the lists of what was computed and sent, newest last."""

    x: list[list[Number]]
    computed: list[list[list[tuple[Fraction, list[Number]]]]]
    packets: list[list[list[tuple[Fraction, list[Number]]]]]


def refusal(system: CompiledSystem, *, in_time: bool) -> str:
    """Say why there is no reference, "" if there is one.

    Parameters
    ----------
    system
        The compiled scene.
    in_time
        For a run in time; else for the eigenvalues of a frame.
    """
    for kind in system.kinds:
        functions = [kind.derivative, *(c.tick for c in kind.clocks), *(s.send for s in kind.sends)]
        if not all(function.is_a("SXFunction") and is_rational(function) for function in functions):
            return f"the equations of {kind.name} hold functions whose values are rounded"
        if any(receive.edge is not None for clock in kind.clocks for receive in clock.receives):
            return f"{kind.name} looks at each sender by itself"
        if any(r.operator not in ("mean", "sum") for clock in kind.clocks for r in clock.receives):
            return f"{kind.name} hears a maximum or minimum"
        if not _is_affine(kind.derivative):
            return f"between its ticks {kind.name} is not linear"
        if in_time and _changes(kind.derivative):
            return f"a force on {kind.name} changes between its ticks"
        if not in_time and not all(_is_affine(function, heard_only=True) for function in functions):
            return f"{kind.name} is not linear in what it hears"
    if in_time and any(link.channel is not None for link in system.links):
        return "packets get lost or come late by chance"
    return ""


def _is_affine(function: Any, *, heard_only: bool = False) -> bool:
    """Say whether a function's slopes over all but its parameters are constant, or those over what it hears."""
    symbols = function.sx_in()
    moving = casadi.vertcat(*symbols[:-2])
    slopes = casadi.jacobian(function(*symbols), moving)
    of = casadi.vertcat(*(symbols[3:4] if heard_only and len(symbols) > 5 else [moving]), symbols[-1])
    if heard_only and len(symbols) <= 5:
        of = symbols[-1]
    return not (slopes.nnz() and casadi.depends_on(slopes, of))


def _changes(function: Any) -> bool:
    """Say whether a function looks at the time."""
    symbols = function.sx_in()
    return bool(casadi.depends_on(casadi.densify(function(*symbols)), symbols[-1]))


def _rule(
    function: Any, parameters: Sequence[Fraction], start: Sequence[Sequence[Fraction]] | None
) -> Callable[..., list[Number]]:
    """Return a function over exact numbers and balls of the time and all its arguments but the parameters.

    With a `start` it is what is linear about that point: the slopes, found where the function is affine by
    its values at the units.
    """
    symbols = function.sx_in()
    dense = casadi.Function("dense", symbols, [casadi.densify(function(*symbols))])
    sizes = [symbol.numel() for symbol in symbols[:-2]]

    def walk(parts: Sequence[Sequence[Number]], time: Fraction, number: Callable[[float], Any]) -> list[Any]:
        listed = [number(one) for one in parameters]  # type: ignore[arg-type] # a Fraction is as good
        return evaluate_exact(dense, [*parts, listed, [number(time)]], number=number)[0]  # type: ignore[arg-type] # likewise

    if start is None:
        return lambda time, *parts: walk(parts, time, lambda value: rational_ball(Fraction(value)) + flint.arb(0))
    if not _is_affine(function):
        return _slopes(function, parameters, start)
    zero = [[Fraction(0)] * size for size in sizes]
    still = walk(zero, Fraction(0), Fraction)
    rows: list[list[tuple[int, int, Number]]] = [[] for _ in still]
    for part, size in enumerate(sizes):
        for place in range(size):
            zero[part][place] = Fraction(1)
            for row, (new, old) in enumerate(zip(walk(zero, Fraction(0), Fraction), still, strict=True)):
                if new != old:
                    rows[row].append((part, place, rational_ball(new - old)))
            zero[part][place] = Fraction(0)
    return lambda time, *parts: [sum((parts[i][j] * k for i, j, k in row), 0) for row in rows]


def _slopes(
    function: Any, parameters: Sequence[Fraction], start: Sequence[Sequence[Fraction]]
) -> Callable[..., list[Number]]:
    """Return the product with a function's slopes at a point."""
    symbols = function.sx_in()
    slopes = casadi.densify(casadi.jacobian(function(*symbols), casadi.vertcat(*symbols[:-2])))
    flat = evaluate_exact(
        casadi.Function("slopes", symbols, [slopes]), [*start, list(parameters), [Fraction(0)]]
    )[0]
    places = [(part, place) for part, symbol in enumerate(symbols[:-2]) for place in range(symbol.numel())]
    height = slopes.size1()
    rows = [
        [
            (*place, rational_ball(entry))
            for place, entry in zip(places, flat[row::height], strict=True)
            if entry
        ]
        for row in range(height)
    ]
    return lambda time, *parts: [sum((parts[i][j] * k for i, j, k in row), 0) for row in rows]


def _rate(kind: Kind, parameters: Sequence[Fraction]) -> Any:
    """Return [A B c; 0 0 0] of the continuous equations, exact."""
    n_x, n_u = len(kind.states), len(kind.holds)
    symbols = kind.derivative.sx_in()
    dense = casadi.Function("dense", symbols, [casadi.densify(kind.derivative(*symbols))])

    def speed(place: int) -> list[Fraction]:
        unit = [Fraction(place == i) for i in range(n_x + n_u)]
        arguments = [unit[:n_x], unit[n_x:], list(parameters), [Fraction(0)]]
        return evaluate_exact(dense, arguments)[0]

    still = speed(-1)
    columns = [[a - b for a, b in zip(speed(i), still, strict=True)] for i in range(n_x + n_u)] + [still]
    size = n_x + n_u + 1
    rows = [[columns[c][r] if r < n_x else Fraction(0) for c in range(size)] for r in range(size)]
    return flint.fmpq_mat(size, size, [flint.fmpq(e.numerator, e.denominator) for row in rows for e in row])


def _sites(system: CompiledSystem, classes: Classes, *, linear: bool) -> list[_Site]:
    """Build the sites of the representatives, at the present precision."""
    numbers = resolve(system)
    seconds = numbers.timings
    starts = np.cumsum([0] + [group.count for group in system.groups])
    period = {clock.name: seconds[clock.period] for clock in system.clocks}
    link_of = {link.name: link for link in system.links}
    found = []
    for peer, group in zip(classes.peers, classes.groups, strict=True):
        kind = system.kinds[system.groups[group].kind]
        row = numbers.rows[group][peer - int(starts[group])]
        parameters = [Fraction(float(value)) for value in numbers.parameters[group][row]]
        value = dict(zip(kind.parameters, parameters, strict=True))
        delays = tuple(seconds[hold.delay] for hold in kind.holds)
        start_x = tuple(value[state.start] for state in kind.states)
        start_m = tuple(tuple(value[name] for name in clock.starts) for clock in kind.clocks)
        still = [list(start_x), [Fraction(0)] * len(kind.holds)]
        found.append(
            _Site(
                kind=kind,
                group=group,
                ticks=tuple(
                    _rule(
                        clock.tick,
                        parameters,
                        [*still, list(m), [Fraction(0)] * len(clock.receives)] if linear else None,
                    )
                    for clock, m in zip(kind.clocks, start_m, strict=True)
                ),
                sends=tuple(_rule(send.send, parameters, still if linear else None) for send in kind.sends),
                rate=_rate(kind, parameters),
                delays=delays,
                back=tuple(
                    max(
                        (
                            math.ceil(delay / period[clock.clock]) + 1
                            for hold, delay in zip(kind.holds, delays, strict=True)
                            if hold.clock == clock.clock
                        ),
                        default=1,
                    )
                    for clock in kind.clocks
                ),
                sent_back=tuple(
                    math.ceil(
                        max(seconds[name] for name in _delays(system, send.link))
                        / period[link_of[send.link].clock]
                    )
                    + 1
                    for send in kind.sends
                ),
                start_x=start_x,
                start_m=start_m,
            )
        )
    return found


def _delays(system: CompiledSystem, name: str) -> list[str]:
    """Return the timings of all delays of a link."""
    link = next(one for one in system.links if one.name == name)
    return [link.delay, *(pair.delay for pair in link.delays)]


class _Scene:
    """Some peers and who hears whom among them; what happens when."""

    def __init__(self, system: CompiledSystem, sites: Sequence[_Site], whom: _Whom) -> None:
        self.sites, self.whom = sites, whom
        self.seconds = resolve(system).timings
        clocks = {clock.name: clock for clock in system.clocks}
        self.clocks = {
            name: (self.seconds[one.phase] % self.seconds[one.period], self.seconds[one.period])
            for name, one in clocks.items()
        }
        self.clock_of = {link.name: link.clock for link in system.links}
        periods = [period for _, period in self.clocks.values()]
        self.frame = _common(periods) if periods else Fraction(1, 1000)
        self.delay: dict[tuple[str, int, int], Fraction] = {}
        names = [group.name for group in system.groups]
        for link in system.links:
            late = {(names.index(p.sender), names.index(p.receiver)): p.delay for p in link.delays}
            for h in range(len(names)):
                for g in range(len(names)):
                    self.delay[link.name, h, g] = self.seconds[late.get((h, g), link.delay)]

    def instants(self, start: Fraction, end: Fraction) -> list[Fraction]:
        """Return all instants in [start, end) at which something ticks or acts, and both ends."""
        found = {start, end}
        for phase, period in self.clocks.values():
            found |= _ticks(phase, period, start, end)
        for site in self.sites:
            for hold, delay in zip(site.kind.holds, site.delays, strict=True):
                phase, period = self.clocks[hold.clock]
                found |= _ticks((phase + delay) % period, period, start, end)
        return sorted(found)

    def play(self, play: _Play, start: Fraction, end: Fraction) -> None:
        """Go from `start`⁻ to `end`⁻."""
        times = self.instants(start, end)
        for now, following in zip(times[:-1], times[1:], strict=True):
            held = [self._held(play, i, now, before=True) for i in range(len(self.sites))]
            for i, site in enumerate(self.sites):
                for send, rule, packets in zip(site.kind.sends, site.sends, play.packets[i], strict=True):
                    if self._ticks_now(self.clock_of[send.link], now):
                        packets.append((now, rule(now, play.x[i], held[i])))
            for i, site in enumerate(self.sites):
                for place, clock in enumerate(site.kind.clocks):
                    if self._ticks_now(clock.clock, now):
                        r = [self._heard(play, i, one, now) for one in clock.receives]
                        before = play.computed[i][place]
                        m = [before[-1][1][row] for row in clock.memories] if clock.memories else []
                        before.append((now, site.ticks[place](now, play.x[i], held[i], m, r)))
            for i, site in enumerate(self.sites):
                u = self._held(play, i, now, before=False)
                play.x[i] = _move(site, play.x[i], u, following - now)

    def _ticks_now(self, clock: str, now: Fraction) -> bool:
        phase, period = self.clocks[clock]
        return (now - phase) % period == 0

    def _held(self, play: _Play, i: int, now: Fraction, *, before: bool) -> list[Number]:
        """Return what the holds of a peer put out, just before or after a moment."""
        site = self.sites[i]
        place = {clock.clock: number for number, clock in enumerate(site.kind.clocks)}
        found: list[Number] = []
        for hold, delay in zip(site.kind.holds, site.delays, strict=True):
            for time, values in reversed(play.computed[i][place[hold.clock]]):
                if time + delay < now or (time + delay == now and not before):
                    found.append(values[hold.output] if len(values) > hold.output else 0)
                    break
            else:
                found.append(0)
        return found

    def _heard(self, play: _Play, i: int, receive: Any, now: Fraction) -> Number:
        """Return what a receive of a peer hears at a tick."""
        total: Number = 0
        for j, weight in self.whom(receive.link, receive.operator, i):
            site = self.sites[j]
            delay = self.delay[receive.link, site.group, self.sites[i].group]
            place = next(n for n, send in enumerate(site.kind.sends) if send.link == receive.link)
            packet = next(p for time, p in reversed(play.packets[j][place]) if time + delay <= now)
            total = total + packet[receive.channel] * rational_ball(weight)
        return total


def _common(periods: Sequence[Fraction]) -> Fraction:
    """Return the least common multiple."""
    denominator = math.lcm(*(period.denominator for period in periods))
    return Fraction(math.lcm(*(int(period * denominator) for period in periods)), denominator)


def _ticks(phase: Fraction, period: Fraction, start: Fraction, end: Fraction) -> set[Fraction]:
    first = math.ceil((start - phase) / period)
    return {phase + k * period for k in range(first, math.ceil((end - phase) / period))}


def _move(site: _Site, x: Sequence[Number], u: Sequence[Number], duration: Fraction) -> list[Number]:
    """Let the continuous states run with held inputs."""
    if duration not in site.steps:
        length = flint.fmpq(duration.numerator, duration.denominator)
        site.steps[duration] = [
            [(place, entry) for place, entry in enumerate(row) if not entry.is_zero()]
            for row in flint.arb_mat(site.rate * length).exp().tolist()[: len(x)]
        ]
    both = [*x, *u, 1]
    return [sum((both[place] * entry for place, entry in row), 0) for row in site.steps[duration]]


def frame_matrices(system: CompiledSystem, classes: Classes) -> list[tuple[str, int, Any]]:
    """Return the one-frame maps of the common motion and of each class's differences.

    Each is (name, how often the whole holds it, `flint.arb_mat`), at the present precision. Where a class of
    n equal peers moves so that its sum is zero, all else rests and each hears −w times itself.

    Parameters
    ----------
    system, classes
        The compiled scene, for which `refusal` is "", and its `classes_of`.
    """
    sites = [_homogeneous(site) for site in _sites(system, classes, linear=True)]
    found = [("common", 1, _map(_Scene(system, sites, _common_whom(sites, classes))))]
    for place, count in enumerate(classes.counts):
        if count > 1:
            whom = _difference_whom(sites, classes, place)
            found.append((f"difference {place}", count - 1, _map(_Scene(system, [sites[place]], whom))))
    return found


def _homogeneous(site: _Site) -> _Site:
    """Leave out constant forces."""
    for row in range(len(site.kind.states)):
        site.rate[row, site.rate.ncols() - 1] = 0
    return site


def _totals(sites: Sequence[_Site], classes: Classes, link: str, i: int) -> list[tuple[int, Fraction]]:
    """Return what a peer of class i weighs each class that sends over a link by, all its peers together."""
    found = []
    for j, site in enumerate(sites):
        weight = classes.weights[link][i][j] * (classes.counts[j] - (1 if i == j else 0))
        if weight and any(send.link == link for send in site.kind.sends):
            found.append((j, weight))
    return found


def _common_whom(sites: Sequence[_Site], classes: Classes) -> _Whom:
    def whom(link: str, operator: str, i: int) -> list[tuple[int, Fraction]]:
        heard = _totals(sites, classes, link, i)
        share = sum((w for _, w in heard), Fraction(0)) if operator == "mean" else Fraction(1)
        return [(j, weight / share) for j, weight in heard]

    return whom


def _difference_whom(sites: Sequence[_Site], classes: Classes, place: int) -> _Whom:
    def whom(link: str, operator: str, i: int) -> list[tuple[int, Fraction]]:
        heard = _totals(sites, classes, link, place)
        share = sum((w for _, w in heard), Fraction(0)) if operator == "mean" else Fraction(1)
        own = classes.weights[link][place][place]
        return [(0, -own / share)] if own and any(j == place for j, _ in heard) else []

    return whom


def _map(scene: _Scene) -> Any:
    """Return the map of one frame, without the states that nobody reads: a matrix of balls."""
    sizes = [len(site.names) for site in scene.sites]
    n = sum(sizes)
    columns = []
    for column in range(n):
        state = [int(column == row) for row in range(n)]
        play = _from_state(scene, state)
        scene.play(play, Fraction(0), scene.frame)
        columns.append(_to_state(scene, play))
    kept = list(range(n))
    while True:  # what nobody reads adds an eigenvalue 0 and nothing else
        read = [c for c in kept if any(not _is_zero(columns[c][r]) for r in kept)]
        if len(read) == len(kept):
            break
        kept = read
    return flint.arb_mat(len(kept), len(kept), [flint.arb(columns[c][r]) for r in kept for c in kept])


def _is_zero(entry: Number) -> bool:
    return entry == 0 if isinstance(entry, int) else bool(entry.is_zero())


def _from_state(scene: _Scene, state: Sequence[Number]) -> _Play:
    """Return the peers at the start of a frame."""
    play = _Play([], [], [])
    rest = iter(state)
    for site in scene.sites:
        play.x.append([next(rest) for _ in site.kind.states])
        computed, packets = [], []
        for clock, count in zip(site.kind.clocks, site.back, strict=True):
            phase, period = scene.clocks[clock.clock]
            computed.append(
                [(phase - (k + 1) * period, [next(rest) for _ in clock.outputs]) for k in range(count)][::-1]
            )
        for send, count in zip(site.kind.sends, site.sent_back, strict=True):
            phase, period = scene.clocks[scene.clock_of[send.link]]
            packets.append(
                [(phase - (k + 1) * period, [next(rest) for _ in send.channels]) for k in range(count)][::-1]
            )
        play.computed.append(computed)
        play.packets.append(packets)
    return play


def _to_state(scene: _Scene, play: _Play) -> list[Number]:
    """Return the state at the end of a frame."""
    state: list[Number] = []
    for i, site in enumerate(scene.sites):
        state += play.x[i]
        for listed, count in zip(play.computed[i], site.back, strict=True):
            state += [value for _, values in listed[: -count - 1 : -1] for value in values]
        for listed, count in zip(play.packets[i], site.sent_back, strict=True):
            state += [value for _, values in listed[: -count - 1 : -1] for value in values]
    return state


def eigenvalues(matrix: Any) -> list[Any]:
    """Return the eigenvalues of a matrix of balls, approximately, the largest first."""
    if not matrix.nrows():
        return []
    # Of a chain of equal eigenvalues each step of QR gains a few bits: as many steps as bits, each.
    middle = flint.acb_mat(matrix.mid())
    values = [value.mid() for value in middle.eig(algorithm="approx", maxiter=flint.ctx.prec * matrix.nrows())]
    trace = sum((middle[i, i] for i in range(matrix.nrows())), flint.acb(0))
    size = max(1.0, max(float(abs(value).mid()) for value in values))
    assert float(abs(sum(values, flint.acb(0)) - trace).mid()) < RIGID * size, "QR did not converge"
    return sorted(values, key=lambda value: -float(abs(value)))


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The spectral radius to `DIGITS` digits, without the `rigid` eigenvalues that are 1.

    `values` are all eigenvalues, the largest first, as `flint.acb`, each as often as its multiplicity in
    one system.
    """

    radius: Any  # flint.arb
    rigid: int
    values: tuple[Any, ...]

    @property
    def digits(self) -> str:
        """The radius as text."""
        with precision(PRECISIONS[-1]):
            return str(self.radius.str(DIGITS, radius=False))


def spectral_truth(system: CompiledSystem) -> Truth | str:
    """Return the truth about one frame of a scene, or why there is none.

    Two precisions have to agree on the digits.
    """
    reason = refusal(system, in_time=False)
    if reason:
        return reason
    classes = classes_of(system)
    last: Truth | None = None
    for bits in PRECISIONS:
        with precision(bits):
            found = frame_matrices(system, classes)
            most = max(matrix.nrows() for _, _, matrix in found)
            if most > MOST_STATES:
                return f"the eigenvalues of {most} states take too long at {DIGITS} digits"
            truth = _truth([(count, eigenvalues(matrix)) for _, count, matrix in found])
            if last is not None and _agree(last.radius, truth.radius) and last.rigid == truth.rigid:
                return truth
            last = truth
    return f"not certain to {DIGITS} digits at {PRECISIONS[-1]} bits"


def _truth(found: Sequence[tuple[int, list[Any]]]) -> Truth:
    rigid, values, radius = 0, [], flint.arb(0)
    for count, own in found:
        values += own
        for value in own:
            if float(abs(value - 1).mid()) < RIGID:
                rigid += count
            else:
                radius = max(radius, abs(value).mid())
    values.sort(key=lambda value: -float(abs(value)))
    return Truth(radius, rigid, tuple(values))


def _agree(one: Any, other: Any) -> bool:
    apart, size = abs(one - other).mid(), abs(other).mid()
    return bool(apart <= size * flint.arb(10) ** (-DIGITS)) or bool(size < flint.arb(10) ** (-DIGITS))


def exact_course(system: CompiledSystem, duration: Fraction) -> tuple[tuple[str, ...], Any] | str:
    """Return the continuous states of all peers at every tick of the fastest clock, or why they can't be had.

    Parameters
    ----------
    system
        The compiled scene, each peer on its own.
    duration
        In seconds.

    Returns
    -------
    The names (`user[1].cube.x`), and the values (rows, names) in SI, the nearest floats to the truth: its
    balls are smaller than `DIGITS` digits of the largest value.
    """
    reason = refusal(system, in_time=True)
    if reason:
        return reason
    for bits in PRECISIONS:
        with precision(bits):
            names, rows = _course(system, duration)
            largest = max((abs(float(one)) for row in rows for one in row), default=0.0)
            widest = max((float(one.rad()) for row in rows for one in row), default=0.0)
            if widest <= 10.0**-DIGITS * max(largest, 10.0**-DIGITS):
                return names, np.array([[float(one.mid()) for one in row] for row in rows])
    return f"not certain to {DIGITS} digits at {PRECISIONS[-1]} bits"


def _course(system: CompiledSystem, duration: Fraction) -> tuple[tuple[str, ...], list[list[Any]]]:
    """Play a scene from time 0 and keep the states at the ticks."""
    whole = _everybody(system)
    sites = _sites(system, whole, linear=False)
    scene = _Scene(system, sites, _common_whom(sites, whole))
    long_ago = Fraction(-(10**9))
    play = _Play([], [], [])
    for site in sites:
        play.x.append([rational_ball(one) + flint.arb(0) for one in site.start_x])
        play.computed.append([[(Fraction(10**9), _remembered(c, m))] for c, m in zip(site.kind.clocks, site.start_m, strict=True)])
        nothing: list[Number] = [flint.arb(0)] * len(site.kind.holds)
        play.packets.append([[(long_ago, rule(Fraction(0), play.x[-1], nothing))] for rule in site.sends])
    phase, period = min(scene.clocks.values(), key=lambda one: one[1])
    rows, now = [], Fraction(0)
    instants = sorted({Fraction(0), *_ticks(phase, period, Fraction(0), duration + period)})
    for instant in (one for one in instants if one <= duration):
        if instant > now:
            scene.play(play, now, instant)
            now = instant
        rows.append([flint.arb(value) for x in play.x for value in x])
    starts = np.cumsum([0] + [group.count for group in system.groups])
    names = tuple(
        f"{system.groups[site.group].name}[{peer - int(starts[site.group]) + 1}].{state.name}"
        for peer, site in zip(whole.peers, sites, strict=True)
        for state in site.kind.states
    )
    return names, rows


def _remembered(clock: Any, start: Sequence[Fraction]) -> list[Number]:
    """Return the outputs of the tick before the first: what is remembered; no hold puts it out."""
    values: list[Number] = [flint.arb(0)] * len(clock.outputs)
    for row, value in zip(clock.memories, start, strict=True):
        values[row] = rational_ball(value) + flint.arb(0)
    return values


def _everybody(system: CompiledSystem) -> Classes:
    """Return every peer as a class of its own."""
    groups = tuple(place for place, group in enumerate(system.groups) for _ in range(group.count))
    n = len(groups)
    weights = {}
    for link in system.links:
        table = [[Fraction(link.graph.shape == "complete")] * n for _ in groups]
        if link.graph.shape != "complete":
            for (sender, receiver), weight in zip(*arcs(link.graph, n), strict=True):
                table[receiver][sender] += Fraction(float(weight))
        weights[link.name] = tuple(tuple(row) for row in table)
    return Classes((1,) * n, tuple(range(n)), groups, weights)
