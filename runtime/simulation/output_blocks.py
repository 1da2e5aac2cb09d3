"""Simulation of a model in time: blocks of rows.

Takes: a `Simulation`. Gives: `OutputBlock`, `blocks`; `instants_of`, `forces_in_time`, `unsolved`.
Guarantees: a row for time 0 and for every tick of the fastest clock until the end, values before the tick;
the memory used does not grow with the duration; every returned number is finite, or NaN at an absent peer.
Does not: store, write or evaluate the rows (see `trajectory`, `recording`, `summary`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.simulation.forcing import impulses
from apc.simulation.population import FrameEngine
from apc.simulation.simulation import Simulation

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_NAMED = 6  # states in a message


@dataclass(frozen=True, slots=True, eq=False)
class OutputBlock:
    """A block of rows: `time` (rows,) in seconds, `values` (rows, signals) in SI.

    `work` (parts,) is the work in J of each part over all peers, up to the last frame that begins within the
    block; a value of an absent peer is NaN. `stopped` is the name of the signal that left the range of floats
    after the last row, at `stopped_at` seconds; "" if all are finite.
    """

    time: Floats
    values: Floats
    work: Floats
    stopped: str = ""
    stopped_at: float = 0.0


def blocks(
    simulation: Simulation, *, run: int = 0, player: FrameEngine | None = None
) -> Iterator[OutputBlock]:
    """Yield the rows of a simulation from time 0, block by block.

    Parameters
    ----------
    simulation
        The simulation.
    run
        The index among runs of one seed: each has separate losses.
    player
        An engine of this simulation that is not used otherwise; by default a new engine.

    Raises
    ------
    ApcError
        E872 an equation has no solution at some instant, E871 a motion cannot be integrated any further; the
        rows before are yielded first.
    """
    last = int(simulation.settings.duration / simulation.quantum)  # rounds down
    player, length, sample_times = (
        player or simulation.player(),
        simulation.length,
        len(simulation.sample_times),
    )
    work_until_now, stopped, stopped_at = np.zeros(len(simulation.population.parts)), "", 0.0
    player.begin(run)
    for first in range(0, last // simulation.frame + 1, length):
        simulated = player.advance(first, length, forces_in_time(simulation, first))
        instants, is_row = instants_of(simulation, first, length, last)
        is_row &= np.arange(len(is_row)) < simulated.frames * sample_times
        values = simulated.rows[is_row][:, simulation.order]
        time = instants[is_row] * simulation.quantum.numerator / simulation.quantum.denominator
        finite = np.isfinite(values)
        if simulation.presence is not None:
            finite |= ~simulation.presence.of(simulation.signals, instants[is_row])
        stop = int(np.argmin(np.append(finite.all(axis=1), False)))  # the first row that is not finite
        if stop:  # to the last frame that begins by the last row
            work = simulated.work[int(np.flatnonzero(is_row)[stop - 1]) // sample_times]
            if np.isfinite(work).all():  # a product of forces and speeds overflows long before they do
                work_until_now = work.copy()
        if stop < len(time):
            name = simulation.signals[int(np.argmin(finite[stop]))].name
            stopped, stopped_at = name, float(time[stop])
        elif simulated.frames == length and instants[-1] <= last and not player.in_range():
            stopped, stopped_at = "a state that is not recorded", float(time[-1])
        yield OutputBlock(time[:stop], values[:stop], work_until_now, stopped, stopped_at)
        if stopped:
            return
        if simulated.frames < length:
            raise unsolved(simulation, first + simulated.frames)


def unsolved(simulation: Simulation, frame: int) -> ApcError:
    """Return the error E871 or E872 of a frame that could not be simulated."""
    location = SourceLocation(simulation.model.origin.topology)
    at = f"after {float(frame * simulation.frame * simulation.quantum):g} s"
    if not simulation.tolerances:
        message = f"an equation has no solution, or Newton's method finds none, {at}"
        return ApcError(Diagnostic("E872", location, message))
    states = ", ".join(tolerance.state for tolerance in simulation.tolerances[:MOST_NAMED])
    message = (
        f"the motion of {states} can't be integrated {at}: it diverges, an equation has "
        "no value, or a force is discontinuous"
    )
    advice = "model dry friction by tanh instead of sign, or use --method semi-implicit:0.1ms"
    return ApcError(Diagnostic("E871", location, message, advice=advice))


def forces_in_time(simulation: Simulation, first: int) -> list[Floats | None]:
    """Return the impulses of a chunk from frame `first` on: (frames, rows, subsystems) for each member.

    A member without time-varying forces has None.
    """
    result: list[Floats | None] = []
    frames = first + np.arange(simulation.length)
    for member, forces in zip(simulation.population.members, simulation.forces, strict=True):
        if not forces:
            result.append(None)
            continue
        program = member.program
        offsets = np.array([start for start, _ in program.intervals], dtype=np.int64)
        lengths = np.tile(np.array([index for _, index in program.intervals], dtype=np.int64), len(frames))
        quanta = (frames[:, None] * simulation.frame + offsets).reshape(-1)
        starts = quanta * simulation.quantum.numerator / simulation.quantum.denominator
        of_subsystems = [
            impulses(force, starts, lengths)[:, program.rates.forced].reshape(len(frames), -1)
            for force in forces
        ]
        result.append(np.ascontiguousarray(np.stack(of_subsystems, axis=-1)))
    return result


def instants_of(
    simulation: Simulation, first: int, count: int, last: int
) -> tuple[Integers, NDArray[np.bool_]]:
    """Return the instant in quanta of each row of some frames, and which rows are output: those until
    `last`.
    """
    sample_times = np.array(simulation.sample_times, dtype=np.int64)
    instants = (first + np.arange(count))[:, None] * simulation.frame + sample_times
    is_row = ((sample_times > sample_times[0]) | simulation.ticks_at_zero | (instants == 0)) & (
        instants <= last
    )
    return instants.reshape(-1), is_row.reshape(-1)
