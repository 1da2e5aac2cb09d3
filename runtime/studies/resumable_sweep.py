"""A quantity at every combination of some parameters' values, each finished part stored at once.

Takes: a `Model`, the values of each swept parameter, the quantity.
Gives: `Sweep`, `sweep`; `part_points`.
Guarantees: the rows and their order do not depend on processes or interruptions; a sweep with a target file
uses its finished parts; the target is written when all parts are finished, and the parts are then removed.
Does not: start processes (see `processes`, `cluster`), or print.
"""

from __future__ import annotations

import hashlib
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import near_start
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import is_special
from apc.compiler.timings import part
from apc.lifting.numeric_model import numeric_model
from apc.network.nominal_criterion import limitations, refuse_channel_number
from apc.parameter_values.parameter_names import notes_for_all_groups
from apc.result import Result
from apc.studies.finished_parts import SweepParts, open_parts
from apc.studies.grid import Grid, build_grid, check_size, parse_axis
from apc.studies.quantities import BEGINNINGS, Cells, by_criterion, find_quantity
from apc.studies.stability_criteria import (
    MEAN_SQUARE,
    NOMINAL,
    PASSIVE,
    criterion_of,
    refuse_timing_parameter,
)
from apc.studies.work import Computed, Work, compute_part, program_versions
from apc.support.memory import refuse_beyond
from apc.support.option_value import Values
from apc.support.processes import (
    Patience,
    Workers,
    cores,
    local_processes,
    model_bytes,
    results,
    this_process,
)
from apc.support.tables import BLOCK, TableColumn, check_table_path, read_table, write_table

if TYPE_CHECKING:
    import pandas

LOCATION = SourceLocation("sweep")

# Points of a part: a third of a second of analyses, the loss if a process is killed; more for quick points,
# as long as there are at least SHARES parts; and at most MOST_PARTS files in a folder.
PART_POINTS, QUICK_POINTS = 64, 8192
SHARES = 32
MOST_PARTS = 10_000
# Seconds of computing in this process before others are started: starting them takes about a second.
SERIAL_SECONDS = 2.0

Progress = Callable[[int, int], None]  # points done, points in all

LOST = Diagnostic(
    "E889",
    LOCATION,
    "a worker process exited unexpectedly: stopped, out of memory, or started by a "
    "script that sweeps when it is imported",
    fix="--jobs 1",
    advice="in a script, call the sweep within if __name__ == '__main__':",
)


@dataclass(frozen=True, slots=True, eq=False)
class Sweep(Result):
    """The rows of a sweep, by columns: swept parameters first, in SI, then results.

    `columns` and `column` return them: numbers as float64 arrays (n,), NaN where missing; others as object
    arrays. Rows in the file `out` are read from there, and not stored in `held`. `counts` and `messages` are
    the numbers of points by verdict and by message. `made_of` is the provenance: model, axes, versions.
    `notes` are remarks on damaged or reused parts.
    """

    shown_by = "parameter_studies_output:sweep"

    topology: str
    of: str
    grid: Grid
    listed: tuple[TableColumn, ...]
    held: Cells | None
    counts: Counter[str]
    messages: Counter[str]
    out: Path | None
    made_of: Mapping[str, Any]
    notes: tuple[str, ...]

    @property
    def points(self) -> int:
        """The number of rows."""
        return self.grid.points

    @property
    def headings(self) -> tuple[str, ...]:
        """The headings of the columns, such as `verdict` or `contact.stiffness [N/m]`."""
        return tuple(column.heading for column in self.listed)

    @property
    def columns(self) -> Cells:
        """All columns, in the order of `headings`."""
        if self.held is not None:
            return self.held
        assert self.out is not None, "what is in no file is held"
        return read_table(self.out, self.listed)

    def column(self, heading: str) -> NDArray[Any]:
        """Return the column with this heading."""
        index = self.headings.index(heading)
        if self.held is not None:
            return self.held[index]
        assert self.out is not None, "what is in no file is held"
        return read_table(self.out, self.listed[index : index + 1])[0]

    @property
    def verdicts(self) -> tuple[tuple[str, int], ...]:
        """Each verdict with its number of points, the most frequent first."""
        return tuple(sorted(self.counts.items(), key=lambda item: (-item[1], item[0])))

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the sweep as a pandas table, with the headings as its columns."""
        table: pandas.DataFrame = self._shown("table")
        return table


# Bytes of memory per cell, for numbers and shared texts: in its part, in the complete columns, and during
# their concatenation.
CELL = 32


@part("points")
def sweep(
    model: Model,
    over: Mapping[str, Values],
    *,
    of: str = "analyze",
    criterion: str | None = None,
    out: Path | None = None,
    jobs: int | None = None,
    cluster: str | None = None,
    progress: Progress | None = None,
    patience: Patience | None = None,
) -> Sweep:
    """Return a quantity at every combination of some parameters' values.

    Parameters
    ----------
    model
        The compiled topology; its values hold for the parameters that are not swept.
    over
        The values of each swept parameter by its name: a range `"0 N/m:3000 N/m:31"` (`LOW:HIGH:COUNT`, and
        `:log` for equal ratios), or a list, `"0,8 ms"` or `["0 ms", "8 ms"]` or numbers in SI. The last
        parameter varies fastest.
    of
        The quantity to compute, see `quantities.QUANTITIES`: `analyze`, …
    criterion
        "mean-square", "nominal" or "passive", see `critical_values.critical`.
    out
        The file to write, .csv or .parquet. Finished parts are stored next to it until the sweep is complete,
        and used by the same sweep later. Without a file the rows are only returned.
    jobs
        The number of processes; 1 is this process. By default the number of cores, after some seconds in this
        process.
    cluster
        The address of a Dask scheduler that computes instead of local processes.
    progress
        Called with the numbers of finished and of all points, at the start and after each part.
    patience
        The time limit for a part without a result, by default none.

    Raises
    ------
    ApcError
        E622, E881 to E883, E896, E204, … an invalid axis; E884 an unknown quantity; E885 the folder of parts
        has the name of something else; E878, E887 or E601 the target cannot be written; E888 the cluster;
        E889 a process ended, or no result came in time. Finished parts remain stored.
    """
    check_size(over.values())
    grid = build_grid([parse_axis(model, name, values) for name, values in over.items()])
    chosen_criterion = criterion_of(model, criterion, LOCATION, [axis.free for axis in grid.axes])
    work_of = by_criterion(of, chosen_criterion)
    quantity = find_quantity(model, work_of)
    for axis in grid.axes:
        if chosen_criterion == PASSIVE:
            refuse_timing_parameter(model, axis.free, LOCATION, chosen_criterion)
        if chosen_criterion == NOMINAL:
            refuse_channel_number(model, axis.free, LOCATION, instead=f"--criterion {MEAN_SQUARE}")
        if axis.free.label == of.partition(":")[2].strip():
            message = f"{axis.free.label} is swept, so its critical value is undefined"
            raise ApcError(
                Diagnostic("E884", LOCATION, message, advice="use --of critical:PATH with another parameter")
            )
    if out is not None:
        check_table_path(out, "out=")
    if jobs is not None and jobs < 1:
        raise ApcError(Diagnostic("E889", LOCATION, "number of processes", "1 or more", str(jobs)))
    width = len(grid.axes) + len(quantity.columns)
    message = f"{grid.points:,} points of {width} columns"
    is_filed = _is_stored_in_file(out)
    needed = (min(grid.points, 2 * BLOCK) if is_filed else grid.points) * width * CELL
    refuse_beyond(
        needed,
        "E883",
        LOCATION,
        message,
        "use fewer values" if is_filed else "use fewer values, or out=FILE.parquet",
    )
    work = Work(model_bytes(model), work_of, grid, part_points(grid.points, quick=quantity.quick))
    made_of = _description(model, work)
    parts = _open_storage(out, made_of)
    executors = Executors(jobs, cluster, patience or Patience())
    notes = _compute_missing(work, parts, executors, progress)
    columns = (*(TableColumn(axis.heading) for axis in grid.axes), *quantity.columns)
    counts = Counter[str](), Counter[str]()
    blocks, held = _blocks(work, parts, [column.kind for column in columns], counts), None
    if isinstance(parts, _Memory):
        held = tuple(np.concatenate(blocks_of_column) for blocks_of_column in zip(*blocks, strict=True))
        blocks = (
            [column[first : first + BLOCK] for column in held] for first in range(0, grid.points, BLOCK)
        )
    if out is not None:
        write_table(out, columns, blocks, made_of)
    if isinstance(parts, SweepParts):
        parts.remove()
    return Sweep(model.name, of, grid, columns, held, *counts, out, made_of, notes)


def part_points(points: int, *, quick: bool) -> int:
    """Return the number of points in a part of the work.

    Parameters
    ----------
    points
        The number of points of the complete sweep.
    quick
        As for `quantities.SweepQuantity`.
    """
    quick_points = min(points // SHARES, QUICK_POINTS) if quick else 0
    return max(PART_POINTS, quick_points, -(-points // MOST_PARTS))


def _description(model: Model, work: Work) -> dict[str, Any]:
    """Return the description of a sweep as plain data; sweeps with equal descriptions have equal rows."""
    parameters = {parameter.name: parameter.value for parameter in model.parameters}
    parameters |= {timing.name: float(timing.value) for timing in model.timings}
    varied = [axis.free for axis in work.grid.axes]
    parameters |= {
        f"{group.name}.{value.name}": value.value for group in model.groups for value in group.values
    }
    return {
        "topology": model.name,
        "peers": model.peers,
        "of": work.of,
        "limitations": [
            *near_start(numeric_model(model)),
            *limitations(model, network=not work.of.startswith(BEGINNINGS[MEAN_SQUARE]), varied=varied),
            *notes_for_all_groups(model, varied),
        ],
        "points": work.grid.points,
        "over": [
            {
                "parameter": axis.free.label,
                "unit": axis.unit,
                "values": [float(value) for value in axis.values],
            }
            for axis in work.grid.axes
        ],
        "parameters": parameters,
        "texts": dict(model.origin.digests),
        "model": hashlib.sha256(work.model).hexdigest(),
        "part_points": work.part_points,
        "versions": dict(program_versions()),
    }


class _Memory:
    """Parts stored in memory, with the interface of `finished_parts.SweepParts`."""

    def __init__(self) -> None:
        self._cells: dict[int, Cells] = {}

    def write(self, part: int, cells: Cells) -> None:
        """Store the cells of a part."""
        self._cells[part] = cells

    def read(self, part: int) -> Cells | None:
        """Return the cells of a part, None if they are not stored."""
        return self._cells.get(part)

    def finished(self) -> set[int]:
        """Return the indices of the stored parts."""
        return set(self._cells)


_Storage = SweepParts | _Memory


def _is_stored_in_file(out: Path | None) -> bool:
    """Return whether the rows are written to a regular file, which can be read again."""
    return out is not None and not is_special(out)


def _open_storage(out: Path | None, made_of: Mapping[str, Any]) -> _Storage:
    """Return the storage of finished parts: a folder next to the target file, or memory."""
    return open_parts(out, made_of) if out is not None and _is_stored_in_file(out) else _Memory()


@dataclass(frozen=True, slots=True)
class Executors:
    """The executors of a sweep: a number of local processes, or a cluster's address; and their time limit.

    Without a number, parts are computed in this process first, and on all cores if that takes long.
    """

    jobs: int | None
    cluster: str | None
    patience: Patience


def _compute_missing(
    work: Work, stored: _Storage, executors: Executors, progress: Progress | None
) -> tuple[str, ...]:
    """Compute the missing parts and store each at once; return notes on damaged and reused parts."""
    finished = stored.finished()
    missing = [part for part in range(work.parts) if part not in finished or stored.read(part) is None]
    damaged = [part for part in missing if part in finished]
    done = work.grid.points - sum(len(work.points_of(part)) for part in missing)
    repeated = "was damaged or written by another user and is computed again"
    notes = [f"part {part} {repeated}" for part in damaged]
    if done:
        notes.append(f"{done:,} points were computed before")
    if progress:
        progress(done, work.grid.points)
    if not missing:
        return tuple(notes)
    for computed in _parts(work, missing, executors):
        if computed.versions != program_versions():
            raise ApcError(_version_error(computed, executors.cluster))
        stored.write(computed.part, computed.cells)
        done += len(work.points_of(computed.part))
        if progress:
            progress(done, work.grid.points)
    return tuple(notes)


def _parts(work: Work, missing: Sequence[int], executors: Executors) -> Iterator[Computed]:
    """Yield the missing parts, each when it is computed."""
    remaining, jobs = list(missing), executors.jobs
    if jobs is None and executors.cluster is None:
        jobs, begun = cores(), time.monotonic()
        while remaining and (jobs == 1 or time.monotonic() - begun < SERIAL_SECONDS):
            yield compute_part(work, remaining.pop(0))
    if remaining:
        with _workers(work, min(jobs or cores(), len(remaining)), executors.cluster) as workers:
            yield from results(workers, remaining, executors.patience, LOCATION)


def _workers(work: Work, jobs: int, cluster: str | None) -> AbstractContextManager[Workers[int, Computed]]:
    """Return the workers of a sweep: a cluster, this process, or local processes."""
    if cluster is not None:
        from apc.studies.cluster import cluster_workers

        return cluster_workers(compute_part, work, cluster)
    if jobs == 1:
        return nullcontext(this_process(compute_part, work))
    return local_processes(compute_part, work, jobs, LOST)


def _version_error(computed: Computed, cluster: str | None) -> Diagnostic:
    """Return the error for a worker with other library versions than this process."""
    here = dict(program_versions())
    other = [f"{name} {got} (here {here[name]})" for name, got in computed.versions if here[name] != got]
    message = f"a worker has {', '.join(other)}: equal results are not guaranteed; install the same versions"
    return Diagnostic("E888", SourceLocation(cluster or "sweep"), message)


def _blocks(
    work: Work, stored: _Storage, kinds: Sequence[str], counts: tuple[Counter[str], Counter[str]]
) -> Iterator[list[NDArray[Any]]]:
    """Yield the rows as blocks of columns, the axes' values first.

    The verdicts and messages of the rows are added to `counts`.
    """
    values = [np.array([float(value) for value in axis.values]) for axis in work.grid.axes]
    pending: list[list[NDArray[Any]]] = []
    rows = 0
    for number in range(work.parts):
        cells = stored.read(number)
        if cells is None:  # another process completed the same sweep and removed the part
            cells = compute_part(work, number).cells
        indices = work.grid.indices(work.points_of(number))
        columns = [value[indices[:, axis]] for axis, value in enumerate(values)] + list(cells)
        counts[0].update(cells[0].tolist())
        counts[1].update(cells[-1].tolist())
        pending.append(
            [
                _as_integers(column) if kind == "count" else column
                for column, kind in zip(columns, kinds, strict=True)
            ]
        )
        rows += len(indices)
        while rows >= BLOCK or (rows and number == work.parts - 1):
            joined = [np.concatenate(blocks_of_column) for blocks_of_column in zip(*pending, strict=True)]
            yield [values[:BLOCK] for values in joined]
            rows = max(rows - BLOCK, 0)
            pending = [[values[BLOCK:] for values in joined]]


def _as_integers(numbers: NDArray[np.float64]) -> NDArray[Any]:
    """Return numbers as Python integers, None for NaN."""
    is_missing = np.isnan(numbers)
    cells = np.where(is_missing, 0.0, numbers).astype(np.int64).astype(object)
    cells[is_missing] = None
    return cells
