"""A scene made ready to be played in time: all peers, what they hear, what is recorded, who plays them.

Takes: a `Model`, its `Settings`, the signals wanted.
Gives: `Simulation`, `prepare`; `check_length`, `size_note`, what it will come to.
Guarantees: time is counted in whole quanta; what would not fit the memory is refused before it is built.
Does not: play it (see `blocks`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.compiler.words import no_more
from apc.frame.ages import stamped
from apc.frame.exchange import CommunicationGraph, build_exchange
from apc.frame.finite_equations import finite_equations
from apc.frame.jacobians import SubsystemJacobians, jacobians
from apc.frame.parameters import ResolvedNumbers, resolve
from apc.frame.schedule import Propagate, Schedule
from apc.frame.scheduling import build_schedules
from apc.memory import refuse_beyond
from apc.network.nominal import refuse_range
from apc.network.timetable import ArrivalProcess, Route, Timetable, luck_of, routes_of
from apc.simulation.flow import Flow, Tolerance, flow_of, rows_to_move, state_scales
from apc.simulation.forcing import SubsystemForcing, site_forcing
from apc.simulation.machine import CompiledEngine, LoadedLibrary, library_of
from apc.simulation.pairs import count_pairs
from apc.simulation.population import (
    FrameEngine,
    Population,
    build_population,
    exchanges_within,
    instants_within,
    refuse_unheard_of,
)
from apc.simulation.program import GroupProgram, Program, build_member
from apc.simulation.propagate import perturbed, rates, transition_rows
from apc.simulation.settings import CVODES, EXACT, WHERE_NEEDED, Method, Settings, check_step
from apc.simulation.signals import (
    Signal,
    SignalSelection,
    choose,
    local_signals,
    sent_states,
    signals_of,
)
from apc.simulation.stepwise import InterpretedEngine
from apc.simulation.writing import build_program

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Numbers that one call of a player takes and gives out, at most, if a frame has fewer: 4 MiB stay in the
# machine's caches.
CHUNK = 2**19
ROW = Fraction(1, 1000)  # seconds from row to row of a scene in which nothing ticks
MOST_FRAMES = 2000  # of one chunk: what has left the range of floats is noticed at its end
NUMBERS_A_PAIR = 16  # what one peer looks at of itself and of another, mostly
NUMBER = 64  # bytes of a number of all peers' frame, with what CasADi copies

# Rows of one command, all runs together: at a microsecond a row and peer, which machine code needs, some
# hours. At 1 kHz it is eleven days of simulated time.
MOST_ROWS = 10**9

# A file larger than this is told of beforehand: 1 GB.
LARGE = 10**9

# Bytes of a number: as a float, and in decimal with the comma, mostly.
BINARY, DECIMAL = 8, 20


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """A scene ready to be played.

    `signals` are the columns of what comes out, the `order` (signals,) of which in a row of the population is
    another; `marks` the instants of a frame's rows, in quanta, the first of which makes a row at time 0 only
    unless `ticks_at_zero`; `forces` are those that change with time, of each member's different sites.
    `lucks` are what chance does on the unreliable links, `seed` is what it begins from: that of the settings,
    or of the experiment. `library` is the machine code, None if there is none. `length` frames are played at
    a time.
    `topology` is the system as it was given, without stamps on its packets (see `ages.stamped`).
    `tolerances` are of the states that CVODES moves, `sent` the names of those that peers send as they are.
    """

    system: Model
    topology: Model
    settings: Settings
    population: Population
    signals: tuple[Signal, ...]
    order: Integers
    forces: tuple[tuple[SubsystemForcing, ...], ...]
    lucks: tuple[ArrivalProcess, ...]
    seed: int
    tolerances: tuple[Tolerance, ...]
    sent: tuple[str, ...]
    quantum: Fraction
    frame: int
    marks: tuple[int, ...]
    ticks_at_zero: bool
    library: LoadedLibrary | None
    length: int

    @property
    def how(self) -> str:
        """The method in words of a command line; what is exact throughout is called so."""
        method = self.settings.method
        if method.name != WHERE_NEEDED:
            return str(method)
        return f"{method}, {CVODES}:{method.tolerance:g} elsewhere" if self.tolerances else EXACT

    @property
    def rows(self) -> int:
        """How many rows there are at most: those of whole frames."""
        return (int(self.settings.duration / self.quantum) // self.frame + 1) * len(self.marks)

    def player(self) -> FrameEngine:
        """Return what plays it, with memory of its own."""
        routes = self.population.hearing.routes
        timetable = partial(Timetable, routes, self.lucks, seed=self.seed)
        packets = (lambda run: timetable(run=run)) if routes else None
        if self.library is not None:
            return CompiledEngine(self.library, self.population, packets)
        return InterpretedEngine(self.population, packets)


@part("prepare")
def prepare(
    system: Model,
    settings: Settings,
    *,
    signals: Sequence[str] = (),
    live: bool = False,
) -> Simulation:
    """Do what comes before the first instant.

    Parameters
    ----------
    system
        The compiled scene.
    settings
        How it is played.
    signals
        Patterns of the signals to record, all if there is none; see `signals.choose`.
    live
        Whether it will be played instant by instant, as what is heard at one is known no sooner.

    Raises
    ------
    ApcError
        E870 a continuous equation is not linear and the method is exact, E873 a pattern fits nothing, E874
        the peers are too many, E893 a peer has nothing of its own to stand in for a missing packet, E899 a
        delay is a range, E913 a step that does not fit; and those of `build_schedules`, `build_population`
        and `routes_of`.
    """
    topology = system
    refuse_unheard_of(system)
    refuse_range(system)
    with finite_equations(system.origin.topology):
        plan = plan_of(system, settings.method)
        system = plan.system
        choices = _choices(plan, signals)
        members = _members(plan, choices, settings.method, live=live)
        population = build_population(plan.exchange, members, plan.routes)
    schedule, listed = plan.schedules[0], signals_of(system, choices)
    marks = schedule.marks[:-1]
    timings, quantum = plan.numbers.timings, schedule.quantum
    return Simulation(
        system=system,
        topology=topology,
        settings=settings,
        population=population,
        signals=listed,
        order=_order(system, population, listed),
        forces=tuple(_forces(member) for member in members),
        lucks=tuple(luck_of(system, timings, plan.exchange, route, quantum) for route in plan.routes),
        seed=system.experiment.seed if settings.seed is None else settings.seed,
        tolerances=_tolerances(system, plan.flows),
        sent=tuple(dict.fromkeys(kind.states[i].name for kind in system.kinds for i in sent_states(kind))),
        quantum=quantum,
        frame=schedule.frame,
        marks=marks,
        ticks_at_zero=_ticks_at_zero(system, plan.numbers),
        library=library_of(population) if settings.jit else None,
        length=_chunk_length(population, settings.duration),
    )


def check_length(system: Model, duration: Fraction, *, runs: int = 1) -> None:
    """Refuse to play so long that no one will wait for it.

    Parameters
    ----------
    system
        The compiled scene.
    duration
        How long, in seconds.
    runs
        How often.

    Raises
    ------
    ApcError
        E915 more than `MOST_ROWS` rows.
    """
    timings = {timing.name: timing.value for timing in system.timings}
    row = min((timings[clock.period] for clock in system.clocks), default=ROW)
    if duration * runs <= MOST_ROWS * row:
        return
    longest = float(MOST_ROWS * row / runs)
    each = f" in each of {runs:,} runs" if runs > 1 else ""
    expected = f"at most {longest:.6g} s{each}: a row a tick, {MOST_ROWS:,} in all"
    got, hint = f"{float(duration):.6g} s", f'--duration "{no_more(longest)} s"'
    raise ApcError(
        Diagnostic("E915", SourceLocation(system.origin.topology), "the duration", expected, got, hint)
    )


def size_note(simulation: Simulation, *, decimal: bool) -> str:
    """Return what to tell of a file of all rows, "" if it is small enough not to mention it.

    Parameters
    ----------
    simulation
        The scene, ready.
    decimal
        Whether the file is a text.
    """
    rows, columns = simulation.rows - len(simulation.marks), len(simulation.signals) + 1  # of whole frames
    size = rows * columns * (DECIMAL if decimal else BINARY)
    if size < LARGE:
        return ""
    return f"will hold {rows:,} rows of {columns} columns, about {size / 1e9:.3g} GB"


@dataclass(frozen=True, slots=True, eq=False)
class SimulationPlan:
    """What the peers of a scene do in a frame, before a function of it is built.

    `sites` are the Jacobians of each kind, `flows` what the method moves of it, `schedules` what happens in a
    frame of each group; `routes` are what is heard over unreliable links.
    """

    system: Model
    numbers: ResolvedNumbers
    exchange: CommunicationGraph
    sites: tuple[SubsystemJacobians, ...]
    flows: tuple[Flow | None, ...]
    routes: tuple[Route, ...]
    schedules: tuple[Schedule, ...]


def plan_of(system: Model, method: Method) -> SimulationPlan:
    """Find out what happens in a frame, and refuse what can't be played.

    The plan's system is `stamped`: where ages are asked for, packets say when they were sent.
    """
    system = stamped(system)
    numbers = resolve(system)
    sites = tuple(jacobians(kind) for kind in system.kinds)
    flows = tuple(_flow(system, numbers, place, site, method) for place, site in enumerate(sites))
    exchange = build_exchange(system, numbers.timings)
    patterns = [site.pattern for site in sites]
    schedules = build_schedules(system, numbers.timings, patterns)
    routes = routes_of(system, numbers.timings, exchange, schedules[0].frame_s)
    if routes:
        kept = {route.link: route.frames for route in routes}
        schedules = build_schedules(system, numbers.timings, patterns, kept=kept)
    if not system.clocks:  # then there is one interval, of any length
        schedules = tuple(replace(schedule, quantum=ROW / schedule.frame) for schedule in schedules)
    _check_size(system, exchange, schedules)
    _check_step(system, numbers, schedules, method)
    return SimulationPlan(system, numbers, exchange, sites, flows, routes, schedules)


def _choices(plan: SimulationPlan, signals: Sequence[str]) -> tuple[SignalSelection, ...]:
    """Return what is recorded of each group; refuse more than fits the memory."""
    system = plan.system
    available = [
        local_signals(system.kinds[group.kind], schedule)
        for group, schedule in zip(system.groups, plan.schedules, strict=True)
    ]
    choices = choose(system, available, signals)
    _check_size(system, plan.exchange, plan.schedules, choices)
    return choices


def _members(
    plan: SimulationPlan, choices: Sequence[SignalSelection], method: Method, *, live: bool
) -> list[GroupProgram]:
    """Return the groups as members of a population, those peers that are recorded apart from the others."""
    system, numbers, flows = plan.system, plan.numbers, plan.flows
    linear = [rates(kind, flow.rows if flow else ()) for kind, flow in zip(system.kinds, flows, strict=True)]
    cuts = instants_within(plan.schedules) if live else exchanges_within(plan.schedules)
    programs: dict[Any, Program] = {}
    members = []
    groups = zip(system.groups, plan.schedules, choices, strict=True)
    for group, (item, schedule, choice) in enumerate(groups):
        rows, vectors = numbers.rows[group], numbers.parameters[group]
        moves: Sequence[Floats] | None = None
        is_recorded = choice.wanted.any(axis=1)
        for which, recorded in ((is_recorded, choice.locals), (~is_recorded, ())):
            peers = np.flatnonzero(which)
            if not len(peers):
                continue
            key = (item.kind, id(schedule), recorded)
            if key not in programs:
                programs[key] = build_program(linear[item.kind], schedule, recorded, cuts, flows[item.kind])
            if moves is None:  # what the different sites of a group do over every interval
                moves = transition_rows(linear[item.kind], vectors, programs[key].seconds)
                moves = perturbed(moves, 0) if method.perturbed else moves
            numbered, site = plan.exchange.starts[group] + peers, plan.sites[item.kind]
            members.append(build_member(group, numbered, site, rows[peers], vectors, programs[key], moves))
    return members


def _chunk_length(population: Population, duration: Fraction) -> int:
    """Return how many frames to play at once: equal chunks, none larger than need be."""
    frames = int(duration / (population.frame * population.quantum)) + 1
    pushed = sum(member.program.impulse_rows * len(member.parameters) for member in population.members)
    seen = sum(route.ticks * len(route.pairs) for route in population.hearing.routes)
    numbers = population.marks * population.width + pushed + seen
    most = max(1, min(MOST_FRAMES, CHUNK // max(1, numbers), frames))
    return -(-frames // -(-frames // most))


def _order(system: Model, population: Population, signals: Sequence[Signal]) -> Integers:
    """Return where each signal stands in a row of a population."""
    starts = np.cumsum([0] + [group.count for group in system.groups])
    column_of = {
        (system.groups[member.group].name, peer, local.name): column + place * member.count + i
        for member, column in zip(population.members, population.columns, strict=True)
        for place, local in enumerate(member.program.recorded)
        for i, peer in enumerate((member.peers - starts[member.group] + 1).tolist())
    }
    return np.array([column_of[signal.group, signal.peer, signal.local] for signal in signals], np.int64)


def _ticks_at_zero(system: Model, numbers: ResolvedNumbers) -> bool:
    """Say whether the fastest clock ticks at time 0."""
    if not system.clocks:
        return True
    fastest = min(system.clocks, key=lambda clock: numbers.timings[clock.period])
    return numbers.timings[fastest.phase] == 0


def _check_size(
    system: Model,
    exchange: CommunicationGraph,
    schedules: Sequence[Schedule],
    choices: Sequence[SignalSelection] = (),
) -> None:
    """Refuse so many peers, or so many of them recorded, that one frame of them would not fit the memory."""
    total = sum(
        int(choice.wanted.any(axis=1).sum()) * len(choice.locals) * len(schedule.marks)
        for choice, schedule in zip(choices, schedules, strict=bool(choices))
    )
    for group, schedule in zip(system.groups, schedules, strict=True):
        kind = system.kinds[group.kind]
        lengths = 2  # of intervals, mostly
        own = len(kind.parameters) + lengths * len(kind.states) * (len(kind.states) + len(kind.holds) + 1)
        total += group.count * (own + sum(schedule.depths))
    total += NUMBERS_A_PAIR * count_pairs(system, exchange)
    what = f"{system.peers:,} peers hold {total:,} numbers in a frame, which"
    refuse_beyond(
        NUMBER * total,
        "E874",
        SourceLocation(system.origin.topology),
        what,
        "fewer peers, or fewer --signals",
    )


def _flow(
    system: Model, numbers: ResolvedNumbers, place: int, site: SubsystemJacobians, method: Method
) -> Flow | None:
    """Return what the method moves of a kind, None if that is nothing."""
    kind = system.kinds[place]
    rows = rows_to_move(kind, method)
    if not rows:
        return None
    vectors = [
        vector
        for group, parameter in zip(system.groups, numbers.parameters, strict=True)
        if group.kind == place
        for vector in parameter
    ]
    return flow_of(kind, method, rows, state_scales(system, kind, site, vectors))


def _tolerances(system: Model, flows: Sequence[Flow | None]) -> tuple[Tolerance, ...]:
    """Return the tolerances of all states, each state of several kinds once, with the smallest."""
    result: dict[str, Tolerance] = {}
    for kind, flow in zip(system.kinds, flows, strict=True):
        for tolerance in flow.tolerances(kind) if flow else ():
            if tolerance.state not in result or tolerance.absolute < result[tolerance.state].absolute:
                result[tolerance.state] = tolerance
    return tuple(result.values())


def _check_step(
    system: Model, numbers: ResolvedNumbers, schedules: Sequence[Schedule], method: Method
) -> None:
    fastest = min((numbers.timings[clock.period] for clock in system.clocks), default=ROW)
    lengths = [
        event.duration * schedule.quantum
        for schedule in schedules
        for event in schedule.events
        if isinstance(event, Propagate)
    ]
    check_step(system, method, fastest, max(lengths, default=fastest))


def _forces(member: GroupProgram) -> tuple[SubsystemForcing, ...]:
    """Return the forces that change with time on each different site of a group; none if none does."""
    program = member.program
    if not program.impulse_rows:
        return ()
    return tuple(site_forcing(program.rates, parameter, program.seconds) for parameter in member.parameters)
