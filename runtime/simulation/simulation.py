"""Preparation of a simulation: all peers, their exchange, recorded signals, and the engine.

Takes: a `Model`, its `Settings`, the signals to record.
Gives: `SimulationPlan`, `plan_of`; `Simulation`, `prepare`; `check_joins_and_leaves`; `check_length`,
`size_note`, its expected size.
Guarantees: time is an integer number of quanta. A simulation that would exceed the memory is refused before
it is built.
Does not: run it (see `output_blocks`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.peer_counts import clocks_in_use
from apc.compiler.timings import part
from apc.compiler.wording import no_more
from apc.lifting.data_age import stamped
from apc.linearization.evaluation_errors import finite_equations
from apc.linearization.jacobians import SubsystemJacobians, jacobians
from apc.network.nominal_criterion import refuse_range
from apc.network.packet_schedule import ArrivalProcess, Route, Timetable, arrival_process_of, routes_of
from apc.parameter_values.parameters import ResolvedNumbers, resolve
from apc.simulation.compiled_engine import CompiledEngine, LoadedLibrary, library_of
from apc.simulation.flow import Flow, Tolerance, flow_of, rows_to_move, state_scales
from apc.simulation.forcing import SubsystemForcing, subsystem_forcing
from apc.simulation.interpreted_engine import InterpretedEngine
from apc.simulation.pairwise import count_pairs
from apc.simulation.population import (
    DeliverySource,
    FrameEngine,
    Population,
    build_population,
    exchanges_within,
    instants_within,
    refuse_unheard_of,
)
from apc.simulation.presence import Presence
from apc.simulation.program import GroupProgram, Program, build_member
from apc.simulation.program_builder import build_program
from apc.simulation.propagate import perturbed, rates, transition_rows
from apc.simulation.settings import CVODES, DEFAULT, EXACT, WHERE_NEEDED, Method, Settings, check_step
from apc.simulation.signals import (
    Signal,
    SignalSelection,
    choose,
    local_signals,
    sent_states,
    signals_of,
)
from apc.support.extension_table import require_extension
from apc.support.memory import refuse_beyond
from apc.timing.communication_graph import CommunicationGraph, build_comm_graph
from apc.timing.schedule import Propagate, Schedule
from apc.timing.scheduling import build_schedules

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Limit of the numbers that one call of an engine reads and returns, if one frame has fewer: 4 MiB stay in the
# processor's caches.
CHUNK = 2**19
ROW = Fraction(1, 1000)  # seconds from row to row of a model in which nothing ticks
MOST_FRAMES = 2000  # of one chunk: an overflow is detected at its end only
NUMBERS_A_PAIR = 16  # typical number of values that one pairwise evaluation reads
NUMBER = 64  # bytes of memory for one stored number, with CasADi's copies

# Limit of the rows of one command, over all runs: some hours at a microsecond per row and peer, the speed of
# machine code. At 1 kHz it is eleven days of simulated time.
MOST_ROWS = 10**9

# File size from which a note is printed beforehand: 1 GB.
LARGE = 10**9

# Bytes of a number: as a float, and in decimal with the comma, mostly.
BINARY, DECIMAL = 8, 20


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """A model prepared for simulation.

    `signals` are the columns of the output; `order` (signals,) are their indices in a row of the population.
    `sample_times` are the instants of a frame's rows, in quanta; the first one gives a row at time 0 only,
    unless `ticks_at_zero`. `forces` are the time-varying forces on each member's different subsystems.
    `arrival_processes` are the random losses and delays of the unreliable links, with the seed `seed`.
    `library` is the machine code, None if there is none. `length` frames are simulated per chunk. `topology`
    is the given model, without time stamps on its packets (see `data_age.stamped`). `tolerances` are those of
    the states integrated by CVODES, `sent` the names of the states that peers send unchanged. `presence` are
    the instants at which peers join and leave, None if all peers are always present.
    """

    model: Model
    topology: Model
    settings: Settings
    population: Population
    signals: tuple[Signal, ...]
    order: Integers
    forces: tuple[tuple[SubsystemForcing, ...], ...]
    arrival_processes: tuple[ArrivalProcess, ...]
    seed: int
    tolerances: tuple[Tolerance, ...]
    sent: tuple[str, ...]
    quantum: Fraction
    frame: int
    sample_times: tuple[int, ...]
    ticks_at_zero: bool
    library: LoadedLibrary | None
    length: int
    presence: Presence | None = None

    @property
    def how(self) -> str:
        """The integration method in command-line notation; "exact" if all transitions are exact."""
        method = self.settings.method
        if method.name != WHERE_NEEDED:
            return str(method)
        return f"{method}, {CVODES}:{method.tolerance:g} elsewhere" if self.tolerances else EXACT

    @property
    def rows(self) -> int:
        """An upper bound on the number of rows: that of complete frames."""
        return (int(self.settings.duration / self.quantum) // self.frame + 1) * len(self.sample_times)

    def player(self, deliveries: Callable[[int], DeliverySource] | None = None) -> FrameEngine:
        """Return a new engine for this simulation, with its own memory.

        `deliveries` gives the packets of a run over unreliable links; by default a `Timetable`.
        """
        if self.presence is not None:
            engine: FrameEngine = require_extension("changing_counts").changing_engine(self, deliveries)
            return engine
        routes = self.population.exchange_program.routes
        timetable = partial(Timetable, routes, self.arrival_processes, seed=self.seed)
        packets = deliveries or ((lambda run: timetable(run=run)) if routes else None)
        if self.library is not None:
            return CompiledEngine(self.library, self.population, packets)
        return InterpretedEngine(self.population, packets)


@part("prepare")
def prepare(
    model: Model,
    settings: Settings,
    *,
    signals: Sequence[str] = (),
    live: bool = False,
) -> Simulation:
    """Return a model prepared for simulation, at time 0.

    Parameters
    ----------
    model
        The model.
    settings
        The simulation settings.
    signals
        Patterns of the signals to record, all signals without patterns; see `signals.choose`.
    live
        Whether it is executed instant by instant, with packets that arrive in real time.

    Raises
    ------
    ApcError
        E870 a continuous equation is not linear and the method is exact, E873 a pattern without a match, E874
        the peers are too many, E893 a peer has no own value as the substitute for a missing packet, E899 a
        delay is a range, E913 a step that does not fit, E914 an invalid join or leave; and the errors of
        `build_schedules`, `build_population` and `routes_of`.
    """
    topology = model
    refuse_unheard_of(model)
    refuse_range(model)
    with finite_equations(model):
        plan = plan_of(model, settings.method)
        model = plan.model
        choices = _choices(plan, signals)
        members = _members(plan, choices, settings.method, live=live)
        population = build_population(plan.comm_graph, members, plan.routes)
    schedule, recorded = plan.schedules[0], signals_of(model, choices)
    presence: Presence | None = None
    if model.experiment.joins or model.experiment.leaves:
        extension = require_extension("changing_counts")
        presence = extension.presence_of(model, schedule, settings.duration)
    sample_times = schedule.sample_times[:-1]
    timings, quantum = plan.numbers.timings, schedule.quantum
    return Simulation(
        model=model,
        topology=topology,
        settings=settings,
        population=population,
        signals=recorded,
        order=_order(model, population, recorded),
        forces=tuple(_forces(member) for member in members),
        arrival_processes=tuple(
            arrival_process_of(model, timings, plan.comm_graph, route, quantum) for route in plan.routes
        ),
        seed=model.experiment.seed if settings.seed is None else settings.seed,
        tolerances=_tolerances(model, plan.flows),
        sent=tuple(
            dict.fromkeys(
                peer_type.states[i].name for peer_type in model.peer_types for i in sent_states(peer_type)
            )
        ),
        quantum=quantum,
        frame=schedule.frame,
        sample_times=sample_times,
        ticks_at_zero=_ticks_at_zero(model, plan.numbers),
        library=library_of(population) if settings.jit else None,
        length=_chunk_length(population, settings.duration),
        presence=presence,
    )


def check_joins_and_leaves(model: Model) -> None:
    """Raise E914 for an invalid join or leave in the experiment of a model, E882 without the extension."""
    experiment = model.experiment
    if items := (*experiment.joins, *experiment.leaves):
        duration = experiment.duration or 1 + max(item.at for item in items)
        schedule = plan_of(model, DEFAULT).schedules[0]
        require_extension("changing_counts").presence_of(model, schedule, duration)


def check_length(model: Model, duration: Fraction, *, runs: int = 1) -> None:
    """Raise E915 for a duration that would take too long to simulate.

    Parameters
    ----------
    model
        The model.
    duration
        The duration in seconds.
    runs
        The number of runs.

    Raises
    ------
    ApcError
        E915 more than `MOST_ROWS` rows.
    """
    timings = {timing.name: timing.value for timing in model.timings}
    row = min((timings[clock.period] for clock in model.clocks), default=ROW)
    if duration * runs <= MOST_ROWS * row:
        return
    longest = float(MOST_ROWS * row / runs)
    each = f" in each of {runs:,} runs" if runs > 1 else ""
    expected = f"at most {longest:.6g} s{each} ({MOST_ROWS:,} rows, one for each tick)"
    got, fix = f"{float(duration):.6g} s", f'--duration "{no_more(longest)} s"'
    raise ApcError(Diagnostic("E915", SourceLocation(model.origin.topology), "duration", expected, got, fix))


def size_note(simulation: Simulation, *, decimal: bool) -> str:
    """Return a note on the size of a file of all rows, "" if the size is below LARGE.

    Parameters
    ----------
    simulation
        The prepared simulation.
    decimal
        Whether the file is text.
    """
    rows, columns = (
        simulation.rows - len(simulation.sample_times),
        len(simulation.signals) + 1,
    )  # of whole frames
    size = rows * columns * (DECIMAL if decimal else BINARY)
    if size < LARGE:
        return ""
    return f"will hold {rows:,} rows of {columns} columns, about {size / 1e9:.3g} GB"


@dataclass(frozen=True, slots=True, eq=False)
class SimulationPlan:
    """The events of a frame of all peers, before functions are built.

    `subsystems` are the Jacobians of each peer type, `flows` the equations of each peer type that the method
    integrates, `schedules` the events of each group's frame; `routes` are the receptions over unreliable
    links. `model` is stamped: if ages are recorded, packets contain their time of sending.
    """

    model: Model
    numbers: ResolvedNumbers
    comm_graph: CommunicationGraph
    subsystems: tuple[SubsystemJacobians, ...]
    flows: tuple[Flow | None, ...]
    routes: tuple[Route, ...]
    schedules: tuple[Schedule, ...]


def plan_of(model: Model, method: Method) -> SimulationPlan:
    """Return the simulation plan of a model: its numbers, flows, routes and schedules.

    Raises ApcError for a model that cannot be simulated.
    """
    model = stamped(model)
    numbers = resolve(model)
    subsystems = tuple(jacobians(peer_type) for peer_type in model.peer_types)
    flows = tuple(
        _flow(model, numbers, index, subsystem, method) for index, subsystem in enumerate(subsystems)
    )
    comm_graph = build_comm_graph(model, numbers.timings)
    patterns = [subsystem.pattern for subsystem in subsystems]
    schedules = build_schedules(model, numbers.timings, patterns)
    routes = routes_of(model, numbers.timings, comm_graph, schedules[0].frame_s)
    if routes:
        stored = {route.link: route.frames for route in routes}
        schedules = build_schedules(model, numbers.timings, patterns, stored=stored)
    if not model.clocks:  # then there is one interval, of any length
        schedules = tuple(replace(schedule, quantum=ROW / schedule.frame) for schedule in schedules)
    _check_size(model, comm_graph, schedules)
    _check_step(model, numbers, schedules, method)
    return SimulationPlan(model, numbers, comm_graph, subsystems, flows, routes, schedules)


def _choices(plan: SimulationPlan, signals: Sequence[str]) -> tuple[SignalSelection, ...]:
    """Return the recorded signals of each group; raise an error if they exceed the memory."""
    model = plan.model
    available = [
        local_signals(model.peer_types[group.peer_type], schedule)
        for group, schedule in zip(model.groups, plan.schedules, strict=True)
    ]
    choices = choose(model, available, signals)
    _check_size(model, plan.comm_graph, plan.schedules, choices)
    return choices


def _members(
    plan: SimulationPlan, choices: Sequence[SignalSelection], method: Method, *, live: bool
) -> list[GroupProgram]:
    """Return the members of the population: the recorded peers of each group, then its other peers."""
    model, numbers, flows = plan.model, plan.numbers, plan.flows
    linear = [
        rates(peer_type, flow.rows if flow else ())
        for peer_type, flow in zip(model.peer_types, flows, strict=True)
    ]
    segment_ends = instants_within(plan.schedules) if live else exchanges_within(plan.schedules)
    programs: dict[Any, Program] = {}
    members = []
    groups = zip(model.groups, plan.schedules, choices, strict=True)
    for group, (model_group, schedule, choice) in enumerate(groups):
        rows, parameter_vectors = numbers.rows[group], numbers.parameters[group]
        transitions: Sequence[Floats] | None = None
        is_recorded = choice.selected.any(axis=1)
        for mask, recorded in ((is_recorded, choice.locals), (~is_recorded, ())):
            peers = np.flatnonzero(mask)
            if not len(peers):
                continue
            program_key = (model_group.peer_type, schedule, recorded)
            if program_key not in programs:
                programs[program_key] = build_program(
                    linear[model_group.peer_type],
                    schedule,
                    recorded,
                    segment_ends,
                    flows[model_group.peer_type],
                )
            if transitions is None:  # transitions of a group's subsystems over every interval
                transitions = transition_rows(
                    linear[model_group.peer_type], parameter_vectors, programs[program_key].seconds
                )
                transitions = perturbed(transitions, 0) if method.perturbed else transitions
            peer_numbers, subsystem = (
                plan.comm_graph.starts[group] + peers,
                plan.subsystems[model_group.peer_type],
            )
            members.append(
                build_member(
                    group,
                    peer_numbers,
                    subsystem,
                    rows[peers],
                    parameter_vectors,
                    programs[program_key],
                    transitions,
                )
            )
    return members


def _chunk_length(population: Population, duration: Fraction) -> int:
    """Return the number of frames per chunk: chunks of nearly equal length within the limits."""
    frames = int(duration / (population.frame * population.quantum)) + 1
    impulse_numbers = sum(
        member.program.impulse_rows * len(member.parameters) for member in population.members
    )
    packet_numbers = sum(route.ticks * len(route.pairs) for route in population.exchange_program.routes)
    numbers = population.sample_count * population.width + impulse_numbers + packet_numbers
    longest = max(1, min(MOST_FRAMES, CHUNK // max(1, numbers), frames))
    return -(-frames // -(-frames // longest))


def _order(model: Model, population: Population, signals: Sequence[Signal]) -> Integers:
    """Return the index of each signal in a row of the population."""
    starts = np.cumsum([0] + [group.count for group in model.groups])
    column_of = {
        (model.groups[member.group].name, peer, local.name): column + index * member.count + i
        for member, column in zip(population.members, population.columns, strict=True)
        for index, local in enumerate(member.program.recorded)
        for i, peer in enumerate((member.peers - starts[member.group] + 1).tolist())
    }
    return np.array([column_of[signal.group, signal.peer, signal.local] for signal in signals], np.int64)


def _ticks_at_zero(model: Model, numbers: ResolvedNumbers) -> bool:
    """Return whether the fastest clock ticks at time 0."""
    used = clocks_in_use(model)
    clocks = [clock for clock in model.clocks if clock.name in used]
    if not clocks:
        return True
    fastest = min(clocks, key=lambda clock: numbers.timings[clock.period])
    return numbers.timings[fastest.phase] == 0


def _check_size(
    model: Model,
    comm_graph: CommunicationGraph,
    schedules: Sequence[Schedule],
    choices: Sequence[SignalSelection] = (),
) -> None:
    """Raise ApcError E874 if the arrays of one frame, with the recorded signals, exceed the memory."""
    total = sum(
        int(choice.selected.any(axis=1).sum()) * len(choice.locals) * len(schedule.sample_times)
        for choice, schedule in zip(choices, schedules, strict=bool(choices))
    )
    for group, schedule in zip(model.groups, schedules, strict=True):
        peer_type = model.peer_types[group.peer_type]
        interval_lengths = 2  # most schedules have two, each with its own transition matrix
        numbers_per_peer = len(peer_type.parameters) + interval_lengths * len(peer_type.states) * (
            len(peer_type.states) + len(peer_type.holds) + 1
        )
        total += group.count * (numbers_per_peer + sum(schedule.depths))
    total += NUMBERS_A_PAIR * count_pairs(model, comm_graph)
    message = f"{model.peers:,} peers with {total:,} numbers in a frame"
    refuse_beyond(
        NUMBER * total,
        "E874",
        SourceLocation(model.origin.topology),
        message,
        "use fewer peers or fewer --signals",
    )


def _flow(
    model: Model, numbers: ResolvedNumbers, index: int, subsystem: SubsystemJacobians, method: Method
) -> Flow | None:
    """Return the equations of a peer type that the method integrates, None if it integrates no state."""
    peer_type = model.peer_types[index]
    rows = rows_to_move(peer_type, method)
    if not rows:
        return None
    parameter_vectors = [
        vector
        for group, vectors_of_group in zip(model.groups, numbers.parameters, strict=True)
        if group.peer_type == index
        for vector in vectors_of_group
    ]
    return flow_of(peer_type, method, rows, state_scales(model, peer_type, subsystem, parameter_vectors))


def _tolerances(model: Model, flows: Sequence[Flow | None]) -> tuple[Tolerance, ...]:
    """Return the tolerances of all integrated states; a state of several peer types has the smallest."""
    result: dict[str, Tolerance] = {}
    for peer_type, flow in zip(model.peer_types, flows, strict=True):
        for tolerance in flow.tolerances(peer_type) if flow else ():
            if tolerance.state not in result or tolerance.absolute < result[tolerance.state].absolute:
                result[tolerance.state] = tolerance
    return tuple(result.values())


def _check_step(
    model: Model, numbers: ResolvedNumbers, schedules: Sequence[Schedule], method: Method
) -> None:
    """Raise an error for a fixed step that is longer than the fastest clock's period, or far too short."""
    fastest = min((numbers.timings[clock.period] for clock in model.clocks), default=ROW)
    lengths = [
        event.duration * schedule.quantum
        for schedule in schedules
        for event in schedule.events
        if isinstance(event, Propagate)
    ]
    check_step(model, method, fastest, max(lengths, default=fastest))


def _forces(member: GroupProgram) -> tuple[SubsystemForcing, ...]:
    """Return the time-varying forces on each different subsystem of a member; empty without forces."""
    program = member.program
    if not program.impulse_rows:
        return ()
    return tuple(
        subsystem_forcing(program.rates, parameter, program.seconds) for parameter in member.parameters
    )
