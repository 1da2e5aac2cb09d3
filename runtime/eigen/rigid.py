"""The motions that nothing holds back, found in exact arithmetic.

Takes: a `ClosedSystem`, or a `Loop` whose matrix was never built.
Gives: `RigidModes`, `find_rigid_modes`, `rigid_modes_here`, `rigid_modes_before`; `Standing`, `what_stands`;
`stays_rigid`.
Guarantees: found from the equations with the parameters as exact rationals, never from an eigenvalue near 1;
a stiffness of exactly zero frees what it held.
Does not: find a motion that only repeats from frame to frame without standing still in between, or chains of
more than two (a motion growing with t²).

A rigid mode is a constant solution of the homogeneous equations,

    A x + B u = 0,   u = y,   y = X x + U u + M y + R r,   r = W s,   s = X x + U u,

which makes an eigenvector of the frame's map with eigenvalue 1. A drift is a solution x(t) = x₁ + t x₀ with
x₀ such a constant: every value y computed at a tick and every packet s as it was at its own time of sending.
It makes a generalized eigenvector, a Jordan pair.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from operator import mul
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import ANGLES, LENGTH
from apc.eigen.closing import ClosedSystem, Coupling, Loop
from apc.eigen.dominant import misses_one
from apc.eigen.graph_modes import QUICK_PRIME
from apc.eigen.peer_group import PeerGroup, states_of
from apc.eigen.ratios import NotRational, Ratios, open_site
from apc.frame.jacobians import SiteJacobians
from apc.frame.schedule import Act, Propagate, Schedule, Send, Tick, Value
from apc.frame.site import LinearSite

Floats = NDArray[np.float64]

# What most entries of forms are: to multiply by it is worth sparing.
ONE = Fraction(1)

# Of what shifts together, as many are named.
MOST_NAMED = 4

# Systems whose rigid modes are remembered as a guess, and how many states they have at most.
KEPT, FEW_STATES = 64, 200

# Up to so many parameters it is seen whether rigid modes are such for all values of them.
FEW_OPEN = 40

# A linear form in the unknowns, sparse.
Form = dict[int, Fraction]


@dataclass(frozen=True, slots=True, eq=False)
class RigidModes:
    """The invariant subspace to remove before eigenvalues are computed.

    `directions` (n, k) are eigenvectors with eigenvalue 1, `generalized` (n, drifts) the second vectors
    of Jordan pairs, both over the state of the closed system; `names` says what moves in each direction.
    `exact` holds the same vectors, directions first, as rationals.
    """

    directions: Floats
    generalized: Floats
    names: tuple[str, ...]
    exact: tuple[tuple[Fraction, ...], ...]

    @property
    def drifts(self) -> int:
        """The number of motions that grow with time for want of damping."""
        return int(self.generalized.shape[1])

    @property
    def basis(self) -> Floats:
        """All vectors to remove (n, k + drifts)."""
        return np.hstack([self.directions, self.generalized])


def find_rigid_modes(system: ClosedSystem | Loop, *, with_drifts: bool = True) -> RigidModes:
    """Find the rigid modes of a closed system and the drifts among them, in exact rationals.

    Parameters
    ----------
    system
        The closed system.
    with_drifts
        Whether to look for drifts, which is most of the work.
    """
    exact, numbering, still, vectors = _standing_motions(system)
    pairs = [state for _, state in _drifts(system, exact, numbering, still)] if still and with_drifts else []
    return _rigid_modes(system, vectors, pairs)


def _rigid_modes(
    system: ClosedSystem | Loop, vectors: Sequence[Sequence[Fraction]], pairs: Sequence[Sequence[Fraction]]
) -> RigidModes:
    """Return exact directions, and the second vectors of Jordan pairs, as rigid modes."""
    n = len(system.names)
    return RigidModes(
        directions=exact_columns(vectors, n),
        generalized=exact_columns(pairs, n),
        names=tuple(
            ", ".join(name for name, entry in zip(system.names, vector, strict=True) if entry)
            for vector in vectors
        ),
        exact=tuple(tuple(vector) for vector in (*vectors, *pairs)),
    )


def rigid_modes_here(system: ClosedSystem) -> RigidModes:
    """Return the rigid modes of a system whose matrix is that of its sites' numbers, without drifts.

    Where the matrix tells that 1 is none of its eigenvalues there are none, and none are looked for.
    """
    return _found_here(system)[0]


def _found_here(system: ClosedSystem) -> tuple[RigidModes, list[list[Fraction]]]:
    """Return `rigid_modes_here` and the standing solutions that they are."""
    if misses_one(system.matrix[None], system.error[None])[0]:
        nothing = np.zeros((len(system.names), 0))
        return RigidModes(nothing, nothing, (), ()), []
    _, _, still, vectors = _standing_motions(system)
    return _rigid_modes(system, vectors, []), still


def rigid_modes_before(system: ClosedSystem) -> RigidModes:
    """Return rigid modes of such a system: as many as one of the same states had before, or all of them.

    What was rigid there is seen to be so here, in exact rationals; what it leaves, an eigenvalue 1 that the
    relative coordinates have, is left to be seen. So a system that is analysed again with other numbers is
    spared the search.
    """
    if len(system.names) > FEW_STATES:
        return _found_here(system)[0]
    known = _before(system.name, system.names)
    last = known[0] if known else None  # looked up once: another thread may write there
    if last is not None and _still_stands(last, system):
        return last.modes
    modes, still = _found_here(system)
    equations = tuple((group.exacting, group.jacobians, group.schedule) for group in system.sites)
    known[:] = [_Before(modes, tuple(map(tuple, still)), equations, system.coupling, [])]
    return modes


@dataclass(frozen=True, slots=True, eq=False)
class _Before:
    """The rigid modes of a system, the standing solutions that they are, and what they are solutions of.

    `always` says, once that was asked, whether they are solutions whatever the sites' parameters.
    """

    modes: RigidModes
    still: tuple[tuple[Fraction, ...], ...]
    equations: tuple[tuple[Callable[[], LinearSite], SiteJacobians, Schedule], ...]  # of each site
    coupling: Coupling
    always: list[bool]


@functools.lru_cache(maxsize=KEPT)
def _before(name: str, names: tuple[str, ...]) -> list[_Before]:
    """Return a place for the last of the systems of one name and of these states."""
    return []


def _still_stands(known: _Before, system: ClosedSystem) -> bool:
    """Say whether what stood still in a system does so in another."""
    if not known.still:
        return True
    alike = len(known.equations) == len(system.sites) and all(
        site is group.jacobians and schedule is group.schedule
        for (_, site, schedule), group in zip(known.equations, system.sites, strict=True)
    )
    if alike and (known.coupling is system.coupling or known.coupling == system.coupling):
        if all(one[0] is group.exacting for one, group in zip(known.equations, system.sites, strict=True)):
            return True
        if not known.always:
            known.always.append(_always_stands(known, system))
        if known.always[0]:
            return True
    numbering, exact = _Numbering(system.sites), [group.exact for group in system.sites]
    if any(len(one) != numbering.size for one in known.still):
        return False
    return all(
        not any(any(form.values()) for form in _standing(system, exact, _Numbering(system.sites, one)))
        and tuple(_standing_state(system, exact, numbering, one)) == state
        for one, state in zip(known.still, known.modes.exact, strict=True)
    )


def _always_stands(known: _Before, system: ClosedSystem) -> bool:
    """Say whether what stands still does so for all parameters, as far as quotients of polynomials tell."""
    needed = [_parameters_of(site) for _, site, _ in known.equations]
    starts = np.cumsum([0, *map(len, needed)]).tolist()
    if starts[-1] > FEW_OPEN or not all(site.parameters_suffice for _, site, _ in known.equations):
        return False
    field = Ratios.of(starts[-1])
    sites = []
    try:
        for (_, site, _), places, start in zip(known.equations, needed, starts, strict=False):
            numbers: list[Any] = [Fraction(0)] * site.function.numel_in(4)
            for place, opened in enumerate(places, start):
                numbers[opened] = field.parameter(place)
            sites.append(open_site(site, numbers))
        return stays_rigid(system, sites, solutions=tuple(zip(known.still, known.modes.exact, strict=True)))
    except (NotRational, ArithmeticError, ValueError):
        return False


def _parameters_of(site: SiteJacobians) -> list[int]:
    """Return the places of the parameters that any entry of a site's matrices follows from, by structure."""
    columns = site.function.jac_sparsity(0, 4).get_triplet()[1]
    return sorted(set(columns))


@dataclass(frozen=True, slots=True)
class Standing:
    """What neither grows nor dies out: `translations` and `rotations`, which turn something, `drifts` among
    them, and the rest.

    `unfelt` are directions in which nothing moves: what a memory keeps that nothing reads, and what it adds
    up. `names` says what these are of: a memory, or the common shift of several.
    """

    translations: int
    rotations: int
    drifts: int
    unfelt: int
    names: tuple[str, ...]


def what_stands(system: ClosedSystem | Loop, *, with_drifts: bool = True) -> Standing:
    """Tell the rigid modes that move something from those that do not.

    Something moves where a length or an angle does that changes between the ticks. What a memory that nothing
    reads adds up while peers stand aside grows, too, and is no drift.

    Parameters
    ----------
    system
        The closed system.
    with_drifts
        Whether to look for drifts, which is most of the work.
    """
    exact, numbering, still, vectors = _standing_motions(system)
    turning = _places(system.sites, ANGLES)
    moving = [*turning, *_places(system.sites, (LENGTH,))]  # what turns anything is a rotation
    basis: dict[int, list[Fraction]] = {}
    unfelt = [left for vector in vectors if (left := _beyond(basis, vector, moving)) is not None]
    rates: dict[int, list[Fraction]] = {}
    for weights, state in _drifts(system, exact, numbering, still) if still and with_drifts else []:
        rate = [sum(map(mul, weights, column), Fraction(0)) for column in zip(*vectors, strict=True)]
        # Behind the rate, as one vector, what drifts at it: to be told apart by the rate alone.
        left = _beyond(rates, [*rate, *state], moving)
        if left is not None and (rest := _beyond(basis, left[len(rate) :], moving)) is not None:
            unfelt.append(rest)
    angles = sum(place in turning for place in basis)
    return Standing(
        translations=len(basis) - angles,
        rotations=angles,
        drifts=len(rates),
        unfelt=len(unfelt),
        names=tuple(dict.fromkeys(_shifted(system.names, vector) for vector in unfelt)),
    )


def _shifted(names: Sequence[str], vector: Sequence[Fraction]) -> str:
    """Return what a direction shifts."""
    listed = list(
        dict.fromkeys(name.partition("(")[0] for name, entry in zip(names, vector, strict=True) if entry)
    )
    if len(listed) == 1:
        return listed[0]
    more = ["…"] if len(listed) > MOST_NAMED else []
    return f"the common shift of {', '.join([*listed[:MOST_NAMED], *more])}"


def _places(sites: Sequence[PeerGroup], units: Sequence[str]) -> list[int]:
    """Return the places in the state of what changes between the ticks and has one of some units."""
    found, start = [], 0
    ends = [states_of(group.schedule, group.jacobians) for group in sites]
    for group, size in zip(sites, ends, strict=True):
        states = group.jacobians.kind.states
        found += [start + place for place, state in enumerate(states) if state.unit in units]
        start += size
    return found


def _beyond(
    basis: dict[int, list[Fraction]], vector: Sequence[Fraction], moving: Sequence[int]
) -> list[Fraction] | None:
    """Add what of a vector moves beyond a basis to it; return the vector less that where nothing does."""
    left = list(vector)
    for pivot, other in basis.items():
        if left[pivot]:
            times = left[pivot]
            left = [entry - times * more for entry, more in zip(left, other, strict=True)]
    place = next((place for place in moving if left[place]), None)
    if place is None:
        return left
    basis[place] = [entry / left[place] for entry in left]
    return None


def stays_rigid(
    system: ClosedSystem | Loop,
    others: Sequence[LinearSite],
    *,
    coupling: Coupling | None = None,
    solutions: Sequence[tuple[Sequence[Fraction], Sequence[Fraction]]] | None = None,
) -> bool:
    """Say whether the directions of a system's rigid modes are rigid with other matrices of its sites, too.

    Parameters
    ----------
    system
        The closed system.
    others
        Matrices of each site, over rationals or quotients of polynomials: then for all values of these.
    coupling
        What the sites hear of each other then, where that is another, too.
    solutions
        The standing solutions that the rigid modes are, each with its state, where they are known.
    """
    other = system if coupling is None else replace(system, coupling=coupling)
    numbering = _Numbering(system.sites)
    if solutions is None:
        exact = [group.exact for group in system.sites]
        solutions = _standing_solutions(system, exact, numbering)
    # Of the matrices alone, once for all, by the unknowns in them: of many parts a solution moves few.
    forms: dict[int, list[Form]] = {}
    for form in _standing(other, others, numbering) if solutions else ():
        for index in form:
            forms.setdefault(index, []).append(form)
    for solution, state in solutions:
        moving = (index for index, value in enumerate(solution) if value)
        if any(_value(form, solution) for index in moving for form in forms.get(index, ())):
            return False
        moved = zip(_standing_state(system, others, numbering, solution), state, strict=True)
        if any(one - other for one, other in moved):
            return False
    return True


def _standing_motions(
    system: ClosedSystem | Loop,
) -> tuple[list[LinearSite], _Numbering, list[list[Fraction]], list[list[Fraction]]]:
    """Return the exact sites, the numbers of the unknowns, the standing solutions, and the state of each."""
    exact = [group.exact for group in system.sites]
    numbering = _Numbering(system.sites)
    found = _standing_solutions(system, exact, numbering)
    return exact, numbering, [still for still, _ in found], [state for _, state in found]


def _standing_solutions(
    system: ClosedSystem | Loop, exact: Sequence[LinearSite], numbering: _Numbering
) -> list[tuple[list[Fraction], list[Fraction]]]:
    """Return the standing solutions whose states are independent, each with its state.

    An output nobody reads may be free without being part of the state.
    """
    still = _null_space(
        list(_standing(system, exact, numbering)), numbering.size, split=numbering.size, known=0
    )
    states = [_standing_state(system, exact, numbering, solution) for solution in still]
    return [(still[place], states[place]) for place in _independent(states)]


class _Numbering:
    """Numbers the unknowns of the standing solution: every site's states, then its clocks' outputs.

    With `values` of them (size,), each is that multiple of a single unknown.
    """

    def __init__(self, sites: Sequence[PeerGroup], values: Sequence[Fraction] | None = None) -> None:
        self.values = values
        self.states: list[int] = []
        self.outputs: list[list[int]] = []
        self.size = 0
        for group in sites:
            kind = group.jacobians.kind
            self.states.append(self.size)
            self.size += len(kind.states)
            starts = []
            for partition in kind.clocks:
                starts.append(self.size)
                self.size += len(partition.outputs)
            self.outputs.append(starts)

    def form(self, unknown: int) -> Form:
        """Return an unknown as a form."""
        if self.values is None:
            return {unknown: ONE}
        value = self.values[unknown]
        return {0: value} if value else {}


def _add(form: Form, weight: Any, other: Mapping[int, Fraction]) -> None:
    """Add weight · other to a form in place."""
    if weight:
        for index, value in other.items():
            more = weight if value is ONE else weight * value
            form[index] = form[index] + more if index in form else more


def _combine(terms: Iterable[tuple[Any, Form]]) -> Form:
    """Return the sum of weight · form."""
    total: Form = {}
    for weight, form in terms:
        if weight:
            _add(total, weight, form)
    return total


def _standing(system: ClosedSystem | Loop, exact: Sequence[LinearSite], number: _Numbering) -> Iterator[Form]:
    """Yield the equations of a constant solution, each a form that must vanish."""
    sent = [_standing_sends(site, number, g) for g, site in enumerate(exact)]
    for g, site in enumerate(exact):
        x, u = _standing_inputs(site, number, g)
        for row_a, row_b in zip(site.a, site.b, strict=True):
            yield _combine([*zip(row_a, x, strict=True), *zip(row_b, u, strict=True)])
        for p, (tick, partition) in enumerate(zip(site.ticks, site.kind.clocks, strict=True)):
            y = [number.form(number.outputs[g][p] + o) for o in range(len(partition.outputs))]
            m = [y[o] for o in partition.memories]
            schedule = system.sites[g].schedule
            r = [
                _combine(
                    (weight, sent[h].get((way.link, channel), {}))
                    for way, channel in schedule.ways(p, place)
                    for h, weight in enumerate(system.coupling[way][g])
                )
                for place in range(len(partition.receives))
            ]
            for row in range(len(tick.x)):  # of all variants
                terms = [*zip(tick.x[row], x, strict=True), *zip(tick.u[row], u, strict=True)]
                terms += [*zip(tick.m[row], m, strict=True), *zip(tick.r[row], r, strict=True)]
                yield _combine([*terms, (-1, y[row % len(y)])])


def _standing_inputs(site: LinearSite, number: _Numbering, g: int) -> tuple[list[Form], list[Form]]:
    """Return x and u of a site as forms in the unknowns of the standing solution."""
    partition_of = {partition.clock: p for p, partition in enumerate(site.kind.clocks)}
    x = [number.form(number.states[g] + i) for i in range(len(site.kind.states))]
    u = [number.form(number.outputs[g][partition_of[hold.clock]] + hold.output) for hold in site.kind.holds]
    return x, u


def _standing_sends(site: LinearSite, number: _Numbering, g: int) -> dict[tuple[str, str], Form]:
    """Return what a site sends in the standing solution, by link and channel."""
    x, u = _standing_inputs(site, number, g)
    return {
        (sending.link, channel): _combine([*zip(send.x[c], x, strict=True), *zip(send.u[c], u, strict=True)])
        for send, sending in zip(site.sends, site.kind.sends, strict=True)
        for c, channel in enumerate(sending.channels)
    }


def _standing_state(
    system: ClosedSystem | Loop, exact: Sequence[LinearSite], number: _Numbering, solution: Sequence[Fraction]
) -> list[Fraction]:
    """Return the closed system's state that belongs to a standing solution."""
    state: list[Fraction] = []
    for g, group in enumerate(system.sites):
        start = number.states[g]
        state += solution[start : start + len(group.jacobians.kind.states)]
        state += [solution[number.outputs[g][v.partition] + v.output] for v in group.schedule.carried]
        packets = [packet for packet in system.packets if packet.site == g]
        sends = _standing_sends(exact[g], number, g) if packets else {}
        for packet in packets:
            one = group.schedule.sent[packet.row]
            state.append(_value(sends[one.link, one.channel], solution))
    return state


def _value(form: Form, solution: Sequence[Fraction]) -> Fraction:
    """Return the value of a form at a solution."""
    return sum((weight * solution[index] for index, weight in form.items() if solution[index]), Fraction(0))


class _Ramp:
    """The ramps x(t) = x₁ + t x₀ as forms in their unknowns.

    The unknowns are the weights of the standing solutions in x₀, every site's x₁, and every value its clocks
    compute in a frame; a frame later a value has grown by the frame's length times its standing value.
    """

    def __init__(
        self,
        system: ClosedSystem | Loop,
        exact: Sequence[LinearSite],
        number: _Numbering,
        still: Sequence[Sequence[Fraction]],
    ) -> None:
        self.system, self.exact, self.number, self.still = system, exact, number, still
        self.frame = system.sites[0].schedule.frame_s
        self.size = len(still)
        self.starts: list[int] = []
        self.values: list[dict[Value, int]] = []
        for group in system.sites:
            kind = group.jacobians.kind
            self.starts.append(self.size)
            self.size += len(kind.states)
            computed = [
                Value(p, o, index)
                for p, partition in enumerate(kind.clocks)
                for o in range(len(partition.outputs))
                for index in range(group.schedule.ticks[p])
            ]
            self.values.append({one: self.size + place for place, one in enumerate(computed)})
            self.size += len(computed)

    def slope(self, form: Form) -> Form:
        """Return what a form of the standing solution is in x₀: a form in the weights."""
        return _combine(
            (weight, {place: solution[unknown] for place, solution in enumerate(self.still)})
            for unknown, weight in form.items()
        )

    def rate(self, g: int, state: int) -> Form:
        """Return the constant rate of a continuous state."""
        return self.slope({self.number.states[g] + state: Fraction(1)})

    def position(self, g: int, time: Fraction) -> list[Form]:
        """Return the continuous states of site g at a time in seconds."""
        start, count = self.starts[g], len(self.exact[g].kind.states)
        return [_combine([(1, {start + i: Fraction(1)}), (time, self.rate(g, i))]) for i in range(count)]

    def value(self, g: int, one: Value | None) -> Form:
        """Return a value of site g, of whatever frame."""
        ticks = self.system.sites[g].schedule.ticks[one.partition] if one else 0
        if one is None or not ticks:
            return {}
        frames, index = divmod(one.index, ticks)
        grown = self.slope({self.number.outputs[g][one.partition] + one.output: Fraction(1)})
        first = {self.values[g][Value(one.partition, one.output, index)]: Fraction(1)}
        return _combine([(1, first), (frames * self.frame, grown)])

    def sends(self, g: int) -> tuple[dict[int, Form], dict[int, Form]]:
        """Return what site g sends, and how fast that grows, by row of s."""
        site, schedule = self.exact[g], self.system.sites[g].schedule
        sent: dict[int, Form] = {}
        for event, time, acting in _walk(self.system.sites[g]):
            if isinstance(event, Send):
                matrices = site.sends[event.partition]
                inputs = [*self.position(g, time), *(self.value(g, one) for one in acting)]
                for channel, row in event.rows:
                    weights = [*matrices.x[channel], *matrices.u[channel]]
                    sent[row] = _combine(zip(weights, inputs, strict=True))
        standing = _standing_sends(site, self.number, g)
        growth = {row: self.slope(standing[one.link, one.channel]) for row, one in enumerate(schedule.sent)}
        return sent, growth

    def heard(
        self, g: int, rows: Iterable[int], sent: Sequence[tuple[dict[int, Form], dict[int, Form]]]
    ) -> Form:
        """Return what site g hears at some rows of r together, each packet as it was when it was sent."""
        total: Form = {}
        for one in (self.system.sites[g].schedule.heard[row] for row in rows):
            for h, weight in enumerate(self.system.coupling[one.way][g]):
                if weight:
                    row = self.system.sites[h].schedule.sent.index(one.sent)
                    _add(total, weight, sent[h][0][row])
                    _add(total, -weight * one.lag * self.frame, sent[h][1][row])
        return total

    def equations(self, sent: Sequence[tuple[dict[int, Form], dict[int, Form]]]) -> Iterator[Form]:
        """Yield the equations of a ramp: every value as computed, every rate at both ends of an interval."""
        for g, (site, group) in enumerate(zip(self.exact, self.system.sites, strict=True)):
            for event, time, acting in _walk(group):
                x, u = self.position(g, time), [self.value(g, one) for one in acting]
                if isinstance(event, Propagate):
                    end = self.position(g, time + event.duration * group.schedule.quantum)
                    for i, (a, b) in enumerate(zip(site.a, site.b, strict=True)):
                        for at in (x, end):
                            terms = [*zip(a, at, strict=True), *zip(b, u, strict=True)]
                            yield _combine([*terms, (-1, self.rate(g, i))])
                elif isinstance(event, Tick):
                    tick, partition = site.ticks[event.partition], site.kind.clocks[event.partition]
                    before = (Value(event.partition, o, event.index - 1) for o in partition.memories)
                    inputs = [*x, *u, *(self.value(g, one) for one in before)]
                    inputs += [self.heard(g, rows, sent) for rows in event.heard]
                    for o, k in enumerate(range(len(tick.x))[event.rows(len(partition.outputs))]):
                        row = [*tick.x[k], *tick.u[k], *tick.m[k], *tick.r[k]]
                        own = self.value(g, Value(event.partition, o, event.index))
                        yield _combine([*zip(row, inputs, strict=True), (-1, own)])


def _drifts(
    system: ClosedSystem | Loop,
    exact: Sequence[LinearSite],
    number: _Numbering,
    still: Sequence[Sequence[Fraction]],
) -> list[tuple[list[Fraction], list[Fraction]]]:
    """Return the ramps on top of the standing solutions `still`.

    Of each the weights of these in its rate, and the state at the start of a frame.
    """
    ramp = _Ramp(system, exact, number, still)
    sent = [ramp.sends(g) for g in range(len(exact))]
    states = []
    for solution in _null_space(list(ramp.equations(sent)), ramp.size, split=len(still), known=len(still)):
        state: list[Fraction] = []
        for g, group in enumerate(system.sites):
            state += [_value(form, solution) for form in ramp.position(g, Fraction(0))]
            state += [_value(ramp.value(g, one), solution) for one in group.schedule.carried]
            for packet in system.packets:
                if packet.site == g:
                    now, growth = sent[g][0][packet.row], sent[g][1][packet.row]
                    before = _combine([(1, now), (-packet.lag * ramp.frame, growth)])
                    state.append(_value(before, solution))
        states.append((list(solution[: len(still)]), state))
    return states


def _walk(group: PeerGroup) -> Iterator[tuple[Any, Fraction, tuple[Value | None, ...]]]:
    """Yield each event of a frame with its time in seconds and what every hold puts out just before it."""
    schedule = group.schedule
    acting = list(schedule.acting)
    now = 0
    for event in schedule.events:
        yield event, now * schedule.quantum, tuple(acting)
        if isinstance(event, Propagate):
            now += event.duration
        elif isinstance(event, Act):
            acting[event.hold] = event.value


def _null_space(equations: Sequence[Form], size: int, *, split: int, known: int) -> list[list[Fraction]]:
    """Return the solutions of homogeneous equations that do not vanish on the first `split` unknowns.

    The number of vectors is the dimension of the solutions' part in these unknowns, and their parts there
    are independent. `known` solutions that vanish there are known to exist.

    Notes
    -----
    What two unknowns or one determine is put in its place first: a chain of masses is nothing else.
    """
    rows, bound = _substituted(equations)
    left = [unknown for unknown in range(size) if unknown not in bound]
    place_of = {unknown: place for place, unknown in enumerate(left)}
    rows = [{place_of[unknown]: weight for unknown, weight in form.items()} for form in rows]
    if not left or (rows and _surely_none(rows, len(left), known)):
        return []
    free = _solutions(rows, len(left))
    vectors = []
    for solution in free:
        vector = dict(zip(left, solution, strict=True))
        # What stands for an unknown was put in its place later, or never.
        for unknown, (weight, other) in reversed(bound.items()):
            vector[unknown] = weight * vector[other] if weight else Fraction(0)
        vectors.append([vector[unknown] for unknown in range(size)])
    if not vectors:
        return []
    # Each vector begins with a 1, at an unknown that is 0 in all others.
    reduced, rank = flint.fmpq_mat([[_fmpq(entry) for entry in vector] for vector in vectors]).rref()
    basis = []
    for line in range(rank):
        entries = (reduced[line, column] for column in range(size))
        whole = [Fraction(int(entry.p), int(entry.q)) for entry in entries]
        if any(whole[:split]):
            basis.append(whole)
    return basis


def _substituted(equations: Sequence[Form]) -> tuple[list[Form], dict[int, tuple[Fraction, int]]]:
    """Return equations of three unknowns or more, and each unknown that others gave in terms of another.

    Of those bound, in the order in which they were: a weight and the unknown that it stands before.
    """
    rows = [{unknown: Fraction(weight) for unknown, weight in form.items() if weight} for form in equations]
    holding: dict[int, set[int]] = {}
    for line, form in enumerate(rows):
        for unknown in form:
            holding.setdefault(unknown, set()).add(line)
    bound: dict[int, tuple[Fraction, int]] = {}
    short = [line for line, form in enumerate(rows) if len(form) < 3]
    while short:
        form = rows[short.pop()]
        if not form:
            continue
        # Of two the one that stands in fewer equations.
        (unknown, own), *rest = sorted(form.items(), key=lambda term: len(holding[term[0]]))
        other, weight = (rest[0][0], -rest[0][1] / own) if rest else (unknown, Fraction(0))
        bound[unknown] = weight, other
        for line in holding.pop(unknown):
            changed = rows[line]
            share = changed.pop(unknown) * weight
            if share:
                total = changed.get(other, 0) + share
                if total:
                    changed[other] = total
                    holding[other].add(line)
                else:
                    del changed[other]
                    holding[other].discard(line)
            if len(changed) < 3:
                short.append(line)
    return [form for form in rows if form], bound


def _solutions(rows: Sequence[Form], size: int) -> list[list[Fraction]]:
    """Return independent solutions of homogeneous equations, as many as there are."""
    matrix = flint.fmpq_mat(max(len(rows), 1), size)
    for line, form in enumerate(rows):
        for unknown, weight in form.items():
            matrix[line, unknown] = _fmpq(weight)
    reduced, rank = matrix.rref()
    pivots: list[int] = []
    for line in range(rank):
        pivots.append(next(c for c in range(pivots[-1] + 1 if pivots else 0, size) if reduced[line, c] != 0))
    basis = []
    for unknown in sorted(set(range(size)) - set(pivots)):
        vector = [Fraction(0)] * size
        vector[unknown] = Fraction(1)
        for line, pivot in enumerate(pivots):
            entry = reduced[line, unknown]
            vector[pivot] = Fraction(-int(entry.p), int(entry.q))
        basis.append(vector)
    return basis


def _fmpq(number: Fraction | float) -> Any:
    exact = Fraction(number)
    return flint.fmpq(exact.numerator, exact.denominator)


def _surely_none(rows: Sequence[Form], size: int, known: int) -> bool:
    """Say whether a look modulo a prime already shows no more than `known` solutions; False proves nothing.

    Independent whole-number solutions, freed of common factors, stay independent modulo a prime: there are at
    least as many solutions modulo the prime as over the rationals.
    """
    matrix = flint.nmod_mat(len(rows), size, QUICK_PRIME)
    for line, form in enumerate(rows):
        for index, weight in form.items():
            exact = Fraction(weight)
            if exact.denominator % QUICK_PRIME == 0:
                return False
            scaled = exact.numerator * pow(exact.denominator, -1, QUICK_PRIME)
            matrix[line, index] = scaled % QUICK_PRIME
    return bool(size - matrix.rank() <= known)


def _independent(vectors: Sequence[Sequence[Fraction]]) -> list[int]:
    """Return the places of the vectors that are no combination of those before them."""
    if not vectors or not vectors[0]:
        return []
    matrix = flint.fmpq_mat(
        [
            [flint.fmpq(entry.numerator, entry.denominator) for entry in row]
            for row in zip(*vectors, strict=True)
        ]
    )
    reduced, rank = matrix.rref()
    return [next(c for c in range(len(vectors)) if reduced[line, c] != 0) for line in range(rank)]


def exact_columns(vectors: Sequence[Sequence[Fraction]], n: int) -> Floats:
    """Return exact vectors as the columns of a float matrix (n, len(vectors))."""
    return (
        np.array([[float(entry) for entry in vector] for vector in vectors], dtype=np.float64)
        .reshape(len(vectors), n)
        .T
    )
