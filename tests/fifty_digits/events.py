"""Peers followed event by event, over exact numbers and balls.

Takes: a `Model`.
Gives: `Peer`, `build_peers`; `Happening`, `Play`; `refusal`, `ticks_between`.
Guarantees: shares with the analysis and the simulation what says what the topology is, and nothing that says
what it does: no Jacobian of theirs, no schedule, no lifted map, no mode. Shared are the compiled functions;
the numbers of each peer (`parameters.resolve`); the walk through a function's operations
over exact numbers and whether that is possible (`exact.evaluate_exact`, `is_rational`, `guards.guards_of`);
how a rational becomes a ball (`balls.rational_ball`, `precision`); and in `truth` who hears whom on
a graph (`comm_graph.arcs`) and the row of a topology without clocks (`simulation.ROW`). A mistake in one of
these is the reference's too: `tests.bruteforce` and `tests.schemes` share none of them and stand beside it in
its tests.
Does not: serve what is not linear between events, or draw lots: it says why.

Every computed value and every packet is kept with its time; whoever needs one takes the newest that counts.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import casadi
import flint
import numpy as np

from apc.compiler.compiled import Model, PeerType, count_of
from apc.compiler.interpolation import jacobian
from apc.linearization.jacobians import guards_of
from apc.parameter_values.exact_arithmetic import evaluate_exact, is_rational
from apc.parameter_values.parameters import resolve
from apc.spectrum.ball_arithmetic import rational_ball

Number = Any  # flint.arb, an exact 0 or 1, or an array of these


@dataclass(frozen=True, slots=True, eq=False)
class Peer:
    """One peer: its functions over exact numbers, and what is needed of the past.

    `ticks` and `sends` give a list of numbers of (x, u, m, r) and of (x, u); `rate` is [A B c] (n_x, n_x +
    n_u + 1), exact. `back` counts the ticks kept of each clock, `sent_back` the packets of each link.
    """

    peer_type: PeerType
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
        found = [state.name for state in self.peer_type.states]
        for clock, count in zip(self.peer_type.clocks, self.back, strict=True):
            found += [f"{name}(−{k + 1})" for k in range(count) for name in clock.outputs]
        for send, count in zip(self.peer_type.sends, self.sent_back, strict=True):
            found += [f"{name}(−{k + 1})" for k in range(count) for name in send.channels]
        return tuple(found)


# Who hears whom over a link with an operator, as (sender, weight): place of the peer among those played.
Whom = Callable[[str, str, int], Sequence[tuple[int, Fraction]]]


@dataclass(slots=True)
class Play:
    """The peers in motion: continuous states, and the lists of what was computed and sent, newest last."""

    x: list[list[Number]]
    computed: list[list[list[tuple[Fraction, list[Number]]]]]
    packets: list[list[list[tuple[Fraction, list[Number]]]]]


def refusal(model: Model, *, in_time: bool) -> str:
    """Say why there is no reference, "" if there is one.

    Parameters
    ----------
    model
        The compiled topology.
    in_time
        For a run in time; else for the eigenvalues of a frame.
    """
    for peer_type in (peer_type.linear or peer_type for peer_type in model.peer_types):
        functions = [*(c.tick for c in peer_type.clocks), *(s.send for s in peer_type.sends)]
        if not all(map(is_rational, functions)) or not _has_exact_slopes(peer_type.derivative):
            return f"the equations of {peer_type.name} contain functions whose values are rounded"
        if any(receive.edge is not None for clock in peer_type.clocks for receive in clock.receives):
            return f"{peer_type.name} looks at each sender by itself"
        if any(r.operator not in ("mean", "sum") for clock in peer_type.clocks for r in clock.receives):
            return f"{peer_type.name} hears a maximum or minimum"
        if in_time and any(receive.age for clock in peer_type.clocks for receive in clock.receives):
            return f"{peer_type.name} asks for ages, which are counted from time 0 at first"
        if not _is_affine(peer_type.derivative):
            return f"between its ticks {peer_type.name} is not linear"
        if in_time and _changes_by_itself(peer_type.derivative):
            return f"a force on {peer_type.name} changes with time"
        if in_time and any(_switches_by_time(function) for function in functions):
            return f"at a tick {peer_type.name} asks whether a moment has come, which a rounding decides"
        # What is heard at the start is not looked up: slopes must not depend on it.
        if not in_time and not all(_is_affine(one.tick, slice(3, 4)) for one in peer_type.clocks):
            return f"{peer_type.name} is not linear in what it hears"
    if in_time and any(link.channel is not None for link in model.links):
        return "packets get lost or come late by chance"
    return ""


def _is_affine(function: Any, arguments: slice = slice(-2)) -> bool:
    """Say whether a function's slopes change with neither the time nor these arguments."""
    symbols = function.sx_in()
    slopes = jacobian(function(*symbols), casadi.vertcat(*symbols[:-2]))
    return not (slopes.nnz() and casadi.depends_on(slopes, casadi.vertcat(*symbols[arguments], symbols[-1])))


def _has_exact_slopes(function: Any) -> bool:
    """Say whether nothing rounds what a function multiplies its first arguments by."""
    symbols = function.sx_in()
    if not function.is_a("SXFunction"):
        return False
    slopes = jacobian(function(*symbols), casadi.vertcat(*symbols[:-2]))
    return is_rational(casadi.Function("slopes", symbols, [slopes]))


def _changes_by_itself(function: Any) -> bool:
    """Say whether a function changes with the time."""
    symbols = function.sx_in()
    return bool(casadi.depends_on(casadi.densify(function(*symbols)), symbols[-1]))


def _switches_by_time(function: Any) -> bool:
    """Say whether a function compares the time with something."""
    symbols = function.sx_in()
    return bool(guards_of(casadi.densify(function(*symbols)), symbols[-1]))


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
        return lambda time, *parts: walk(
            parts, time, lambda value: rational_ball(Fraction(value)) + flint.arb(0)
        )
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
    slopes = casadi.densify(jacobian(function(*symbols), casadi.vertcat(*symbols[:-2])))
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


def _rate(peer_type: PeerType, parameters: Sequence[Fraction], *, linear: bool) -> Any:
    """Return [A B c; 0 0 0] of the continuous equations, exact; c is left out when `linear`."""
    n_x, n_u = len(peer_type.states), len(peer_type.holds)
    symbols = peer_type.derivative.sx_in()
    dense = casadi.Function("dense", symbols, [casadi.densify(peer_type.derivative(*symbols))])

    def speed(place: int) -> list[Fraction]:
        unit = [Fraction(place == i) for i in range(n_x + n_u)]
        arguments = [unit[:n_x], unit[n_x:], list(parameters), [Fraction(0)]]
        return evaluate_exact(dense, arguments)[0]

    still = speed(-1)
    columns = [[a - b for a, b in zip(speed(i), still, strict=True)] for i in range(n_x + n_u)]
    columns.append([Fraction(0)] * n_x if linear else still)
    size = n_x + n_u + 1
    rows = [[columns[c][r] if r < n_x else Fraction(0) for c in range(size)] for r in range(size)]
    return _rationals(rows)


def _rationals(rows: Sequence[Sequence[Fraction]]) -> Any:
    entries = [flint.fmpq(entry.numerator, entry.denominator) for row in rows for entry in row]
    return flint.fmpq_mat(len(rows), len(rows), entries)


def received_weights(model: Model, peer: int) -> dict[str, Fraction]:
    """Return the exact sum of the weights that a peer receives over each link with arcs, by its parameter."""
    return {
        count_of(link.name): sum(
            (
                Fraction(repr(weight))
                for (_, receiver), weight in zip(
                    link.graph.arcs.tolist(), link.graph.weights.tolist(), strict=True
                )
                if receiver == peer
            ),
            Fraction(0),
        )
        for link in model.links
        if link.graph.shape == "arcs"
    }


def build_peers(model: Model, peers: Sequence[int], groups: Sequence[int], *, linear: bool) -> list[Peer]:
    """Build some peers, at the present precision.

    Parameters
    ----------
    model
        The compiled topology.
    peers, groups
        Their numbers in the topology, and their groups'.
    linear
        Leave constant forces out, and take the slopes at the start where something is not linear.
    """
    numbers = resolve(model)
    seconds = numbers.timings
    starts = np.cumsum([0] + [group.count for group in model.groups])
    period = {clock.name: seconds[clock.period] for clock in model.clocks}
    link_of = {link.name: link for link in model.links}
    found = []
    for peer, group in zip(peers, groups, strict=True):
        nonlinear = model.peer_types[model.groups[group].peer_type]
        peer_type = nonlinear.linear or nonlinear
        row = numbers.rows[group][peer - int(starts[group])]
        parameters = list(map(Fraction, numbers.parameters[group][row].tolist()))
        value = dict(zip(peer_type.parameters, parameters, strict=True)) | received_weights(model, peer)
        parameters = [value[name] for name in peer_type.parameters]
        delays = tuple(seconds[hold.delay] for hold in peer_type.holds)
        start_x = tuple(value[state.start] for state in peer_type.states)
        start_m = tuple(tuple(value[name] for name in clock.starts) for clock in peer_type.clocks)
        still = [list(start_x), [Fraction(0)] * len(peer_type.holds)]
        found.append(
            Peer(
                peer_type=peer_type,
                group=group,
                ticks=tuple(
                    _rule(
                        clock.tick,
                        parameters,
                        [*still, list(m), [Fraction(0)] * len(clock.receives)] if linear else None,
                    )
                    for clock, m in zip(peer_type.clocks, start_m, strict=True)
                ),
                sends=tuple(
                    _rule(send.send, parameters, still if linear else None) for send in peer_type.sends
                ),
                rate=_rate(peer_type, parameters, linear=linear),
                delays=delays,
                back=tuple(
                    max(
                        (
                            math.ceil(delay / period[clock.clock]) + 1
                            for hold, delay in zip(peer_type.holds, delays, strict=True)
                            if hold.clock == clock.clock
                        ),
                        default=1,
                    )
                    for clock in peer_type.clocks
                ),
                sent_back=tuple(
                    math.ceil(
                        max(seconds[name] for name in _delays(model, send.link))
                        / period[link_of[send.link].clock]
                    )
                    + 1
                    for send in peer_type.sends
                ),
                start_x=start_x,
                start_m=start_m,
            )
        )
    return found


def _delays(model: Model, name: str) -> list[str]:
    """Return the timings of all delays of a link."""
    link = next(one for one in model.links if one.name == name)
    return [*link.delays]


class Happening:
    """Some peers and who hears whom among them; what happens when."""

    def __init__(self, model: Model, subsystems: Sequence[Peer], whom: Whom) -> None:
        self.subsystems, self.whom = subsystems, whom
        self.seconds = resolve(model).timings
        clocks = {clock.name: clock for clock in model.clocks}
        self.clocks = {
            name: (self.seconds[one.phase] % self.seconds[one.period], self.seconds[one.period])
            for name, one in clocks.items()
        }
        self.clock_of = {link.name: link.clock for link in model.links}
        periods = [period for _, period in self.clocks.values()]
        self.frame = _common(periods) if periods else Fraction(1, 1000)
        self.delay: dict[tuple[str, int, int], Fraction] = {}
        names = [group.name for group in model.groups]
        for link in model.links:
            late = {(names.index(p.sender), names.index(p.receiver)): p.delay for p in link.pairs}
            for h in range(len(names)):
                for g in range(len(names)):
                    self.delay[link.name, h, g] = self.seconds[late.get((h, g), link.delay)]

    def instants(self, start: Fraction, end: Fraction) -> list[Fraction]:
        """Return all instants in [start, end) at which something ticks or acts, and both ends."""
        found = {start, end}
        for phase, period in self.clocks.values():
            found |= ticks_between(phase, period, start, end)
        for subsystem in self.subsystems:
            for hold, delay in zip(subsystem.peer_type.holds, subsystem.delays, strict=True):
                phase, period = self.clocks[hold.clock]
                found |= ticks_between((phase + delay) % period, period, start, end)
        return sorted(found)

    def play(self, play: Play, start: Fraction, end: Fraction) -> None:
        """Go from `start`⁻ to `end`⁻."""
        times = self.instants(start, end)
        for now, following in itertools.pairwise(times):
            held = [self._held(play, i, now, before=True) for i in range(len(self.subsystems))]
            for i, subsystem in enumerate(self.subsystems):
                for send, rule, packets in zip(
                    subsystem.peer_type.sends, subsystem.sends, play.packets[i], strict=True
                ):
                    if self._ticks_now(self.clock_of[send.link], now):
                        packets.append((now, rule(now, play.x[i], held[i])))
            for i, subsystem in enumerate(self.subsystems):
                for place, clock in enumerate(subsystem.peer_type.clocks):
                    if self._ticks_now(clock.clock, now):
                        period = self.clocks[clock.clock][1]
                        r = [self._received(play, i, one, now, period) for one in clock.receives]
                        before = play.computed[i][place]
                        m = [before[-1][1][row] for row in clock.memories] if clock.memories else []
                        before.append((now, subsystem.ticks[place](now, play.x[i], held[i], m, r)))
            for i, subsystem in enumerate(self.subsystems):
                u = self._held(play, i, now, before=False)
                play.x[i] = _move(subsystem, play.x[i], u, following - now)

    def _ticks_now(self, clock: str, now: Fraction) -> bool:
        phase, period = self.clocks[clock]
        return (now - phase) % period == 0

    def _held(self, play: Play, i: int, now: Fraction, *, before: bool) -> list[Number]:
        """Return what the holds of a peer put out, just before or after a moment."""
        subsystem = self.subsystems[i]
        place = {clock.clock: number for number, clock in enumerate(subsystem.peer_type.clocks)}
        found: list[Number] = []
        for hold, delay in zip(subsystem.peer_type.holds, subsystem.delays, strict=True):
            for time, values in reversed(play.computed[i][place[hold.clock]]):
                if time + delay < now or (time + delay == now and not before):
                    found.append(values[hold.output] if len(values) > hold.output else 0)
                    break
            else:
                found.append(0)
        return found

    def _received(self, play: Play, i: int, receive: Any, now: Fraction, period: Fraction) -> Number:
        """Return what a receive of a peer hears at a tick, or heard at the one before, a period ago."""
        total: Number = 0
        then = now - period if receive.before else now
        for j, weight in self.whom(receive.link, receive.operator, i):
            subsystem = self.subsystems[j]
            delay = self.delay[receive.link, subsystem.group, self.subsystems[i].group]
            place = next(n for n, send in enumerate(subsystem.peer_type.sends) if send.link == receive.link)
            sent, packet = next(one for one in reversed(play.packets[j][place]) if one[0] + delay <= then)
            value = packet[receive.channel] if receive.age != "alone" else 1
            if receive.age:
                value = value * rational_ball(now - sent)
            total = total + value * rational_ball(weight)
        return total


def _common(periods: Sequence[Fraction]) -> Fraction:
    """Return the least common multiple."""
    denominator = math.lcm(*(period.denominator for period in periods))
    return Fraction(math.lcm(*(int(period * denominator) for period in periods)), denominator)


def ticks_between(phase: Fraction, period: Fraction, start: Fraction, end: Fraction) -> set[Fraction]:
    """Return the ticks of a clock in [start, end)."""
    first = math.ceil((start - phase) / period)
    return {phase + k * period for k in range(first, math.ceil((end - phase) / period))}


def _move(subsystem: Peer, x: Sequence[Number], u: Sequence[Number], duration: Fraction) -> list[Number]:
    """Let the continuous states run with held inputs."""
    if duration not in subsystem.steps:
        length = flint.fmpq(duration.numerator, duration.denominator)
        subsystem.steps[duration] = [
            [(place, entry) for place, entry in enumerate(row) if not entry.is_zero()]
            for row in flint.arb_mat(subsystem.rate * length).exp().tolist()[: len(x)]
        ]
    both = [*x, *u, 1]
    return [sum((both[place] * entry for place, entry in row), 0) for row in subsystem.steps[duration]]
