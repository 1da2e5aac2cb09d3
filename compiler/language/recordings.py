"""Recordings of a quantity or of packets: time tables, traces, output of ping and irtt.

Takes: a path. Gives: `read_time_table`, a `TimeTable`; `read_trace`, a `Trace`; both in SI.
Guarantees: times increase; a delay is 0 or more, or marks a lost packet; an error names its file, line and
column.
Does not: interpret them.
"""

from __future__ import annotations

import math
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import SourceLocation
from apc.compiler.language.csv_tables import Headings, open_table, read_bytes, read_table
from apc.compiler.language.dimensions import SECOND
from apc.compiler.language.ping_recordings import LATEST_DELAY, read_probe
from apc.compiler.language.units import NO_UNIT, Unit
from apc.compiler.number_parsing import plain_float
from apc.compiler.source.reading import brief, fault

DELAY = "delay"  # the column of a trace that is read
TABLE_SUFFIX = ".csv"  # a file of another suffix may be what ping or irtt wrote
RECORDINGS = "packets as ping or irtt wrote them, or a table with a column delay [ms]"
LOST = "lost"  # a packet that never arrived, in a trace; so is a cell with nothing in it


@dataclass(frozen=True, slots=True, eq=False)
class TimeTable:
    """A quantity over time: `times` (n,) in seconds, rising; `numbers` (n,) in SI."""

    name: str
    times: NDArray[np.float64]
    numbers: NDArray[np.float64]


def read_time_table(path: Path, name: str, unit: Unit, named_at: SourceLocation) -> TimeTable:
    """Read a quantity over time: two columns, time and the quantity, and two or more rows of rising time.

    Parameters
    ----------
    path
        The CSV file.
    name, unit
        The name of the quantity, and a unit of its dimension.
    named_at
        The location of the file's reference in the topology.

    Raises
    ------
    ApcError
        As `read_table`, and when the columns or times are not as they must be.
    """
    table = read_table(path, named_at)
    first = table.columns[0]
    if len(table.columns) != 2 or first.unit.dimension != SECOND:
        expected = f"two columns, time [s] and {name} [{unit.text}]"
        raise fault("E702", first.location, "a table over time", expected)
    times, numbers = table.columns
    if numbers.unit.dimension != unit.dimension:
        raise fault("E702", numbers.location, brief(numbers.name), unit.text, numbers.unit.text)
    if table.rows < 2 or not (np.diff(times.numbers) > 0).all():
        expected = "two or more rows of rising time"
        raise fault("E703", times.location, "a table over time", expected)
    return TimeTable(name, times.numbers, numbers.numbers)


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """Recorded one-way delays: `delays` (n,) in seconds, one per packet, infinite for a lost one.

    `program` wrote the file, "" for a table; `interval` is the sending interval in seconds, NaN if the file
    does not contain it.
    """

    delays: NDArray[np.float64]
    program: str = ""
    interval: float = math.nan


def read_trace(path: Path, named_at: SourceLocation) -> Trace:
    """Read the column `delay` of a CSV file: 0 or more per packet; `lost`, or empty, if it was lost.

    Other columns are ignored. An empty line is not a packet. Output of ping or irtt is read by
    `ping_recordings`.

    Parameters
    ----------
    path
        The CSV file.
    named_at
        The location of its reference in the topology, for a file that can't be read.

    Raises
    ------
    ApcError
        E701 it cannot be read, E702 there is no column `delay` in a unit of time, E703 a row or cell is
        invalid, or there is none; E704 a recording of ping or irtt contradicts itself, or holds two runs.
    """
    if path.suffix.lower() != TABLE_SUFFIX:
        data = read_bytes(path, named_at, any_text=True)
        # Windows writes UTF-16 from PowerShell, else a code page, in which the digits are those of ASCII.
        encoding = "utf-16" if data[:2] in (BOM_UTF16_LE, BOM_UTF16_BE) else "utf-8-sig"
        text = data.decode(encoding, "replace")
        if (probe := read_probe(text, str(path))) is not None:
            return Trace(probe.delays, probe.program, probe.interval)
        if DELAY not in text.partition("\n")[0]:
            raise fault("E702", SourceLocation(str(path), 1, 1), "a recording", RECORDINGS)
    with open_table(path, named_at, known=(DELAY,)) as opened:
        column = _delay_column(opened.headings)
        scale = float(opened.headings[column][1].scale)

        def delay(cell: str) -> float:
            if cell.strip() in ("", LOST):
                return math.inf
            seconds = plain_float(cell) * scale
            if not 0 <= seconds <= LATEST_DELAY:
                raise ValueError("no time of a packet")
            return seconds

        expected = f"a time from 0 to {LATEST_DELAY:.0e} s, or {LOST}"
        delays, _ = opened.numbers([column], [delay], "a delay", expected, empty_too=True)
    return Trace(delays)


def _delay_column(names: Headings) -> int:
    """Return the index of the column named delay."""
    got, location = ", ".join(name for name, _, _ in names), names[0][2]
    for column, (name, unit, at) in enumerate(names):
        if name == DELAY:
            if unit.dimension == SECOND:
                return column
            got, location = f"delay {'without a unit' if unit == NO_UNIT else f'in {unit.text}'}", at
    expected = "a column delay in a unit of time"
    raise fault("E702", location, "a trace", expected, brief(got), "delay [ms]")
