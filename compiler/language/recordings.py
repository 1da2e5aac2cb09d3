"""Recordings of a quantity or of packets: time tables, traces, output of ping and irtt.

Takes: a path. Gives: `read_time_table`, a `TimeTable`; `read_trace`, a `Trace`; both in SI.
Guarantees: times increase; a delay is 0 or more, or marks a lost packet; an error names its file, line and
column.
Does not: interpret recordings.
"""

from __future__ import annotations

import math
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import SourceLocation
from apc.compiler.files import InputFile
from apc.compiler.language.csv_tables import Headings, open_table, read_bytes, read_table
from apc.compiler.language.dimensions import SECOND
from apc.compiler.language.ping_recordings import LATEST_DELAY, read_probe
from apc.compiler.language.units import NO_UNIT, Unit
from apc.compiler.number_parsing import plain_float
from apc.compiler.source.reading import brief, fault

DELAY = "delay"  # the column of a trace that is read
TABLE_SUFFIX = ".csv"  # a file with another suffix may be output of ping or irtt
RECORDINGS = "the output of ping or irtt, or a table with a column delay [ms]"
LOST = "lost"  # the text of a lost packet in a trace; an empty cell has the same meaning


@dataclass(frozen=True, slots=True, eq=False)
class TimeTable:
    """A time series of a quantity: increasing `times` (n,) in seconds; `numbers` (n,) in SI units."""

    name: str
    times: NDArray[np.float64]
    numbers: NDArray[np.float64]


def read_time_table(file: InputFile, name: str, unit: Unit, named_at: SourceLocation) -> TimeTable:
    """Return the time series in a CSV file with two columns, time and the quantity, and at least two rows.

    Parameters
    ----------
    file
        The CSV file.
    name, unit
        The name of the quantity, and a unit of its dimension.
    named_at
        The location of the file's reference in the topology.

    Raises
    ------
    ApcError
        As `read_table`; E702 other columns or units, E703 fewer than two rows, or times that do not increase.
    """
    table = read_table(file, named_at)
    first = table.columns[0]
    if len(table.columns) != 2 or first.unit.dimension != SECOND:
        expected = f"two columns, time [s] and {name} [{unit.text}]"
        raise fault("E702", first.location, "table over time", expected)
    times, numbers = table.columns
    if numbers.unit.dimension != unit.dimension:
        raise fault("E702", numbers.location, brief(numbers.name), unit.text, numbers.unit.text)
    if table.rows < 2 or not (np.diff(times.numbers) > 0).all():
        expected = "two or more rows with increasing time"
        raise fault("E703", times.location, "table over time", expected)
    return TimeTable(name, times.numbers, numbers.numbers)


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """Recorded one-way delays: `delays` (n,) in seconds, one per packet, infinite for a lost packet.

    `program` is the program that recorded the packets, "" for a table; `interval` is the sending interval in
    seconds, NaN if the file does not contain it.
    """

    delays: NDArray[np.float64]
    program: str = ""
    interval: float = math.nan


def read_trace(file: InputFile, named_at: SourceLocation) -> Trace:
    """Return the delays of packets from the column `delay` of a CSV file, or from output of ping or irtt.

    A cell is a delay of 0 or more, or `lost` or empty for a lost packet. Other columns are ignored. An empty
    line is not a packet. Output of ping or irtt is read by `ping_recordings`.

    Parameters
    ----------
    file
        The CSV file.
    named_at
        The location of its reference in the topology, for a file that can't be read.

    Raises
    ------
    ApcError
        E701 the file cannot be read, E702 there is no column `delay` in a unit of time, E703 a row or cell is
        invalid, or there is no row; E704 a recording of ping or irtt is inconsistent, or has two runs.
    """
    if file.path.suffix.lower() != TABLE_SUFFIX:
        data = read_bytes(file, named_at, any_text=True)
        # Windows writes UTF-16 from PowerShell, else a code page in which digits are encoded as in ASCII.
        encoding = "utf-16" if data[:2] in (BOM_UTF16_LE, BOM_UTF16_BE) else "utf-8-sig"
        text = data.decode(encoding, "replace")
        if (probe := read_probe(text, str(file.path))) is not None:
            return Trace(probe.delays, probe.program, probe.interval)
        if DELAY not in text.partition("\n")[0]:
            raise fault("E702", SourceLocation(str(file.path), 1, 1), "recording", RECORDINGS)
    with open_table(file, named_at, known=(DELAY,), example="delay [ms]") as opened:
        column = _delay_column(opened.headings)
        scale = float(opened.headings[column][1].scale)

        def delay(cell: str) -> float:
            """Return the delay in a cell in seconds, infinite for a lost packet.

            Raises ValueError for other texts.
            """
            if cell.strip() in ("", LOST):
                return math.inf
            seconds = plain_float(cell) * scale
            if not 0 <= seconds <= LATEST_DELAY:
                raise ValueError("no time of a packet")
            return seconds

        expected = f"a time from 0 to {LATEST_DELAY:.0e} s, or the word {LOST}"
        delays, _ = opened.numbers([column], [delay], "delay", expected, empty_too=True)
    return Trace(delays)


def _delay_column(names: Headings) -> int:
    """Return the index of the column named delay."""
    listed = ", ".join(name for name, _, _ in names)
    got, location = f"the column{'s' * (len(names) > 1)} {listed}", names[0][2]
    for column, (name, unit, at) in enumerate(names):
        if name == DELAY:
            if unit.dimension == SECOND:
                return column
            got, location = "no unit" if unit == NO_UNIT else f"delay in {unit.text}", at
    expected = "a column delay in a unit of time"
    raise fault("E702", location, "trace", expected, brief(got), "delay [ms]")
