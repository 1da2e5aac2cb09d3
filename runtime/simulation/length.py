"""How much a simulation will be: rows and bytes, told or refused before it is played.

Takes: a scene and a duration, or a `Simulation`. Gives: `check_length`, `size_note`.
Guarantees: nothing is computed but a few products.
Does not: say how long it will take: that depends on the machine and the scene.
"""

from __future__ import annotations

from fractions import Fraction

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.simulation.simulation import ROW, Simulation

# Rows of one command, all runs together: at a microsecond a row and peer, which machine code needs, some
# hours. At 1 kHz it is eleven days of simulated time.
MOST_ROWS = 10**9

# A file larger than this is told of beforehand: 1 GB.
LARGE = 10**9

# Bytes of a number: as a float, and in decimal with the comma, mostly.
BINARY, DECIMAL = 8, 20


def check_length(system: CompiledSystem, duration: Fraction, *, runs: int = 1) -> None:
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
    got, hint = f"{float(duration):.6g} s", f'--duration "{longest:.6g} s"'
    raise ApcError(Mistake("E915", Place(system.name), "the duration", expected, got, hint))


def size_note(simulation: Simulation, *, decimal: bool) -> str:
    """Return what to tell of a file of all rows, "" if it is small enough not to mention it.

    Parameters
    ----------
    simulation
        The scene, ready.
    decimal
        Whether the file is a text.
    """
    frames = int(simulation.settings.duration / (simulation.frame * simulation.quantum))
    rows, columns = frames * len(simulation.marks), len(simulation.signals) + 1
    size = rows * columns * (DECIMAL if decimal else BINARY)
    if size < LARGE:
        return ""
    return f"will hold {rows:,} rows of {columns} columns, about {size / 1e9:.3g} GB"
