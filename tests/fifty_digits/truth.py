"""What a topology does to fifty digits, whatever method is measured against it.

Takes: a `Model`.
Gives: `Classes`, `classes_of`; `frame_matrices`, `eigenvalues`, `Truth`, `spectral_truth`; `exact_course`.
Guarantees: digits that are not certain are not given.
Does not: serve every topology (see `bench.events.refusal`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import flint
import numpy as np

from apc.compiler.compiled import Model
from apc.compiler.weights import arcs, exact_weight
from apc.parameter_values.parameters import resolve
from apc.simulation.simulation import ROW
from apc.spectrum.ball_arithmetic import precision, rational_ball
from tests.fifty_digits.events import Happening, Number, Peer, Play, Whom, build_peers, refusal, ticks_between

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
MOST_MOVING = 64  # of them continuous: with their delayed forces and packets they are about twice as many


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


def classes_of(model: Model) -> Classes:
    """Find the peers that can change places: equal ones on complete graphs and stars, else none."""
    rows = resolve(model).rows
    shapes = {link.graph.shape for link in model.links}
    apart = not shapes <= {"complete", "star"}
    counts: dict[tuple[int, ...], int] = {}
    first: dict[tuple[int, ...], int] = {}
    number = 0
    for place, group in enumerate(model.groups):
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
    for link in model.links:
        if link.graph.shape == "complete":
            table = [[Fraction(1)] * len(keys) for _ in keys]
        elif link.graph.shape == "star" and not apart:
            table = [[Fraction((first[c] == 0) != (first[d] == 0)) for d in keys] for c in keys]
        else:
            table = [[Fraction(0)] * len(keys) for _ in keys]
            for (sender, receiver), weight in zip(*arcs(link.graph, number), strict=True):
                table[receiver][sender] += exact_weight(weight)
        weights[link.name] = tuple(tuple(row) for row in table)
    return Classes(
        tuple(counts.values()), tuple(first[key] for key in keys), tuple(key[0] for key in keys), weights
    )


def frame_matrices(model: Model, classes: Classes) -> list[tuple[str, int, Any]]:
    """Return the one-frame maps of the common motion and of each class's differences.

    Each is (name, how often the whole holds it, `flint.arb_mat`), at the present precision. Where a class of
    n equal peers moves so that its sum is zero, all else rests and each hears −w times itself.

    Parameters
    ----------
    model, classes
        The compiled topology, for which `refusal` is "", and its `classes_of`.
    """
    subsystems = build_peers(model, classes.peers, classes.groups, linear=True)
    found = [("common", 1, _map(Happening(model, subsystems, _common_whom(subsystems, classes))))]
    for place, count in enumerate(classes.counts):
        if count > 1:
            whom = _difference_whom(subsystems, classes, place)
            found.append(
                (f"difference {place}", count - 1, _map(Happening(model, [subsystems[place]], whom)))
            )
    return found


def _totals(subsystems: Sequence[Peer], classes: Classes, link: str, i: int) -> list[tuple[int, Fraction]]:
    """Return what a peer of class i weighs each class that sends over a link by, all its peers together."""
    found = []
    for j, subsystem in enumerate(subsystems):
        weight = classes.weights[link][i][j] * (classes.counts[j] - (1 if i == j else 0))
        if weight and any(send.link == link for send in subsystem.peer_type.sends):
            found.append((j, weight))
    return found


def _common_whom(subsystems: Sequence[Peer], classes: Classes) -> Whom:
    def whom(link: str, operator: str, i: int) -> list[tuple[int, Fraction]]:
        received = _totals(subsystems, classes, link, i)
        share = sum((w for _, w in received), Fraction(0)) if operator == "mean" else Fraction(1)
        return [(j, weight / share) for j, weight in received]

    return whom


def _difference_whom(subsystems: Sequence[Peer], classes: Classes, place: int) -> Whom:
    def whom(link: str, operator: str, i: int) -> list[tuple[int, Fraction]]:
        received = _totals(subsystems, classes, link, place)
        share = sum((w for _, w in received), Fraction(0)) if operator == "mean" else Fraction(1)
        own = classes.weights[link][place][place]
        return [(0, -own / share)] if own and any(j == place for j, _ in received) else []

    return whom


def _map(topology: Happening) -> Any:
    """Return the map of one frame, without the states that nobody reads: a matrix of balls."""
    n = sum(len(subsystem.names) for subsystem in topology.subsystems)
    # Every number of the state is a row: what it is of each number of the state at the frame's start.
    play = _from_state(topology, list(np.eye(n, dtype=int).astype(object)))
    topology.play(play, Fraction(0), topology.frame)
    rows = [np.broadcast_to(np.asarray(row, dtype=object), n) for row in _to_state(topology, play)]
    stored = list(range(n))
    while True:  # what nobody reads adds an eigenvalue 0 and nothing else
        read = [c for c in stored if any(not _is_zero(rows[r][c]) for r in stored)]
        if len(read) == len(stored):
            break
        stored = read
    return flint.arb_mat(len(stored), len(stored), [flint.arb(rows[r][c]) for r in stored for c in stored])


def _is_zero(entry: Number) -> bool:
    return entry == 0 if isinstance(entry, int) else bool(entry.is_zero())


def _from_state(topology: Happening, state: Sequence[Number]) -> Play:
    """Return the peers at the start of a frame."""
    play = Play([], [], [])
    rest = iter(state)
    for subsystem in topology.subsystems:
        play.x.append([next(rest) for _ in subsystem.peer_type.states])
        computed, packets = [], []
        for clock, count in zip(subsystem.peer_type.clocks, subsystem.back, strict=True):
            phase, period = topology.clocks[clock.clock]
            computed.append(
                [(phase - (k + 1) * period, [next(rest) for _ in clock.outputs]) for k in range(count)][::-1]
            )
        for send, count in zip(subsystem.peer_type.sends, subsystem.sent_back, strict=True):
            phase, period = topology.clocks[topology.clock_of[send.link]]
            packets.append(
                [(phase - (k + 1) * period, [next(rest) for _ in send.channels]) for k in range(count)][::-1]
            )
        play.computed.append(computed)
        play.packets.append(packets)
    return play


def _to_state(topology: Happening, play: Play) -> list[Number]:
    """Return the state at the end of a frame."""
    state: list[Number] = []
    for i, subsystem in enumerate(topology.subsystems):
        state += play.x[i]
        for listed, count in zip(play.computed[i], subsystem.back, strict=True):
            state += [value for _, values in listed[: -count - 1 : -1] for value in values]
        for listed, count in zip(play.packets[i], subsystem.sent_back, strict=True):
            state += [value for _, values in listed[: -count - 1 : -1] for value in values]
    return state


def eigenvalues(matrix: Any) -> list[Any]:
    """Return the eigenvalues of a matrix of balls, approximately, the largest first."""
    if not matrix.nrows():
        return []
    # Of a chain of equal eigenvalues each step of QR gains a few bits: as many steps as bits, each.
    middle = flint.acb_mat(matrix.mid())
    values = [
        value.mid() for value in middle.eig(algorithm="approx", maxiter=flint.ctx.prec * matrix.nrows())
    ]
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


def spectral_truth(model: Model) -> Truth | str:
    """Return the truth about one frame of a topology, or why there is none.

    Two precisions have to agree on the digits.
    """
    reason = refusal(model, in_time=False)
    if reason:
        return reason
    classes = classes_of(model)
    moving = sum(len(model.peer_types[model.groups[group].peer_type].states) for group in classes.groups)
    last: Truth | None = None
    for bits in PRECISIONS:
        with precision(bits):
            if moving > MOST_MOVING:
                return f"{moving} states of motion take too long at {DIGITS} digits"
            found = frame_matrices(model, classes)
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


def exact_course(model: Model, duration: Fraction) -> tuple[tuple[str, ...], Any] | str:
    """Return the continuous states of all peers at every tick of the fastest clock, or why they can't be had.

    Parameters
    ----------
    model
        The compiled topology, each peer on its own.
    duration
        In seconds.

    Returns
    -------
    The names (`user[1].cube.x`), and the values (rows, names) in SI, the nearest floats to the truth: its
    balls are smaller than `DIGITS` digits of the largest value.
    """
    reason = refusal(model, in_time=True)
    if reason:
        return reason
    for bits in PRECISIONS:
        with precision(bits):
            names, rows = _course(model, duration)
            largest = max((abs(float(one)) for row in rows for one in row), default=0.0)
            widest = max((float(one.rad()) for row in rows for one in row), default=0.0)
            if widest <= 10.0**-DIGITS * max(largest, 10.0**-DIGITS):
                return names, np.array([[float(one.mid()) for one in row] for row in rows])
    return f"not certain to {DIGITS} digits at {PRECISIONS[-1]} bits"


def _course(model: Model, duration: Fraction) -> tuple[tuple[str, ...], list[list[Any]]]:
    """Play a topology from time 0 and keep the states at the ticks."""
    whole = _everybody(model)
    subsystems = build_peers(model, whole.peers, whole.groups, linear=False)
    topology = Happening(model, subsystems, _common_whom(subsystems, whole))
    long_ago = Fraction(-(10**9))
    play = Play([], [], [])
    for subsystem in subsystems:
        play.x.append([rational_ball(one) + flint.arb(0) for one in subsystem.start_x])
        play.computed.append(
            [
                [(Fraction(10**9), _remembered(c, m))]
                for c, m in zip(subsystem.peer_type.clocks, subsystem.start_m, strict=True)
            ]
        )
        nothing: list[Number] = [flint.arb(0)] * len(subsystem.peer_type.holds)
        play.packets.append(
            [[(long_ago, rule(Fraction(0), play.x[-1], nothing))] for rule in subsystem.sends]
        )
    nothing_ticks = Fraction(0), ROW
    phase, period = min(topology.clocks.values(), key=lambda one: one[1], default=nothing_ticks)
    rows, now = [], Fraction(0)
    instants = sorted({Fraction(0), *ticks_between(phase, period, Fraction(0), duration + period)})
    for instant in (one for one in instants if one <= duration):
        if instant > now:
            topology.play(play, now, instant)
            now = instant
        rows.append([flint.arb(value) for x in play.x for value in x])
    starts = np.cumsum([0] + [group.count for group in model.groups])
    names = tuple(
        f"{model.groups[subsystem.group].name}[{peer - int(starts[subsystem.group]) + 1}].{state.name}"
        for peer, subsystem in zip(whole.peers, subsystems, strict=True)
        for state in subsystem.peer_type.states
    )
    return names, rows


def _remembered(clock: Any, start: Sequence[Fraction]) -> list[Number]:
    """Return the outputs of the tick before the first: what is remembered; no hold puts it out."""
    values: list[Number] = [flint.arb(0)] * len(clock.outputs)
    for row, value in zip(clock.memories, start, strict=True):
        values[row] = rational_ball(value) + flint.arb(0)
    return values


def _everybody(model: Model) -> Classes:
    """Return every peer as a class of its own."""
    groups = tuple(place for place, group in enumerate(model.groups) for _ in range(group.count))
    n = len(groups)
    weights = {}
    for link in model.links:
        table = [[Fraction(link.graph.shape == "complete")] * n for _ in groups]
        if link.graph.shape != "complete":
            for (sender, receiver), weight in zip(*arcs(link.graph, n), strict=True):
                table[receiver][sender] += exact_weight(weight)
        weights[link.name] = tuple(tuple(row) for row in table)
    return Classes((1,) * n, tuple(range(n)), groups, weights)
