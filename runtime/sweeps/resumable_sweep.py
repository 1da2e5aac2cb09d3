"""One result at every combination of some parameters' values, each finished part stored at once.

Takes: a `Model`, the values of each swept parameter, the quantity.
Gives: `Sweep`, `sweep`; `part_points`.
Guarantees: the same rows in the same order whoever computes them, interrupted or not; a sweep with a target
takes up its finished parts; the target is written when all of it is there, and its parts are removed then.
Does not: start processes itself (see `processes`, `cluster`), or print.
"""

from __future__ import annotations

import hashlib
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
from apc.frame.parameter_names import notes_for_all_groups
from apc.memory import refuse_beyond
from apc.network.nominal_criterion import limitations, refuse_channel_number
from apc.parameter_studies.stability_criteria import MEAN_SQUARE, NOMINAL, PASSIVE, criterion_of, refuse_time
from apc.processes import Patience, Workers, cores, local_processes, model_bytes, results, this_process
from apc.result import Result
from apc.sweeps.finished_parts import SweepParts, open_parts
from apc.sweeps.grid import Grid, build_grid, check_size, parse_axis
from apc.sweeps.quantities import BEGINNINGS, Cells, by_criterion, find_quantity
from apc.sweeps.work import Computed, Work, compute_part, program_versions
from apc.tables import BLOCK, TableColumn, check_table_path, read_table, write_table

if TYPE_CHECKING:
    import pandas

LOCATION = SourceLocation("sweep")

# Points of a part: a third of a second of analyses, which is what a kill can cost; more where points are
# quick, as long as there are parts for all who compute; and no more files in a folder than one likes to list.
PART_POINTS, QUICK_POINTS = 64, 8192
SHARES = 32
MOST_PARTS = 10_000

Progress = Callable[[int, int], None]  # points done, points in all

LOST = Diagnostic(
    "E889",
    LOCATION,
    "a process that computed ended without a word: stopped from outside, out of memory, or started by a "
    "script that sweeps when it is imported",
    hint="--jobs 1; in a script, if __name__ == '__main__': around the sweep",
)


@dataclass(frozen=True, slots=True, eq=False)
class Sweep(Result):
    """The rows of a sweep, by columns: swept parameters first, in SI, then results.

    `columns` and `column` give them: of numbers a float64 array (n,), NaN where a point has no number; of
    others object arrays. What stands in the file `out` is read from there, and not held. `counts` and
    `messages` say how many points have which verdict and message. `made_of` is its provenance: model, axes,
    versions. `notes` are remarks on exceptions.
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
        """The columns, in the order of `headings`."""
        if self.held is not None:
            return self.held
        assert self.out is not None, "what is in no file is held"
        return read_table(self.out, self.listed)

    def column(self, heading: str) -> NDArray[Any]:
        """Return the column of a heading."""
        index = self.headings.index(heading)
        if self.held is not None:
            return self.held[index]
        assert self.out is not None, "what is in no file is held"
        return read_table(self.out, self.listed[index : index + 1])[0]

    @property
    def verdicts(self) -> tuple[tuple[str, int], ...]:
        """Each verdict and how many points have it, the most frequent first."""
        return tuple(sorted(self.counts.items(), key=lambda item: (-item[1], item[0])))

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the sweep as a pandas table, with the headings as its columns."""
        table: pandas.DataFrame = self._shown("table")
        return table


# Bytes of a cell at hand, of a number as of a word that many rows share: its part's, the whole's, and what
# these are put together from.
CELL = 32


@part("points")
def sweep(
    system: Model,
    over: Mapping[str, str | Sequence[str]],
    *,
    of: str = "analyze",
    criterion: str | None = None,
    out: Path | None = None,
    jobs: int | None = None,
    cluster: str | None = None,
    progress: Progress | None = None,
    patience: Patience | None = None,
) -> Sweep:
    """Compute a result at every combination of some parameters' values.

    Parameters
    ----------
    system
        The compiled topology; its values hold for the parameters that are not swept.
    over
        The values of each swept parameter by its name: a range `"0 N/m:3000 N/m:31"` (`LOW:HIGH:COUNT`, and
        `:log` for equal ratios), or a list, `"0,8 ms"` or `["0 ms", "8 ms"]`. The last one turns fastest.
    of
        The quantity to compute, see `quantities.QUANTITIES`: `analyze`, …
    criterion
        "mean-square" or "nominal", see `critical_values.critical`.
    out
        The file to write, .csv or .parquet. Finished parts are kept beside it until all is done, and the
        same sweep takes them up again. Without it the rows are only returned.
    jobs
        How many processes compute; as many as there are cores if not given. With 1 it is this process.
    cluster
        The address of a Dask scheduler that computes instead.
    progress
        Called with the points done and the points in all, at the start and after each part.
    patience
        How long to wait for processes or a cluster of which nothing comes; for ever if not given.

    Raises
    ------
    ApcError
        An axis is at fault (E622, E881 to E883, E896, E204, …); E884 nothing is computed under that name;
        E885 something else stands where its parts are kept; E878, E887 or E601 the target can't be written;
        E888 the cluster; E889 a process ended, or no result came for too long. Finished parts are kept.
    """
    texts = {name: text if isinstance(text, str) else ",".join(text) for name, text in over.items()}
    check_size(list(texts.values()))
    grid = build_grid([parse_axis(system, name, text) for name, text in texts.items()])
    meant = criterion_of(system, criterion, LOCATION, [axis.free for axis in grid.axes])
    work_of = by_criterion(of, meant)
    quantity = find_quantity(system, work_of)
    for axis in grid.axes:
        if meant == PASSIVE:
            refuse_time(system, axis.free, LOCATION, meant)
        if meant == NOMINAL:
            refuse_channel_number(system, axis.free, LOCATION, instead=f"--criterion {MEAN_SQUARE}")
        if axis.free.label == of.partition(":")[2].strip():
            message = f"{axis.free.label} is swept: there is nothing to look for at one value of it"
            raise ApcError(
                Diagnostic("E884", LOCATION, message, hint="--of critical:PATH with another parameter")
            )
    if out is not None:
        check_table_path(out, "out=")
    if jobs is not None and jobs < 1:
        raise ApcError(Diagnostic("E889", LOCATION, "the number of processes", "1 or more", str(jobs)))
    width = len(grid.axes) + len(quantity.columns)
    message = f"{grid.points:,} points of {width} columns"
    filed = _in_a_file(out)
    needed = (min(grid.points, 2 * BLOCK) if filed else grid.points) * width * CELL
    refuse_beyond(
        needed, "E883", LOCATION, message, "fewer values" if filed else "fewer values, or out=FILE.parquet"
    )
    work = Work(model_bytes(system), work_of, grid, part_points(grid.points, quick=quantity.quick))
    made_of = _description(system, work)
    parts = _stored(out, made_of)
    whose = Whose(jobs or cores(), cluster, patience or Patience())
    notes = _compute_missing(work, parts, whose, progress)
    columns = (*(TableColumn(axis.heading) for axis in grid.axes), *quantity.columns)
    counts = Counter[str](), Counter[str]()
    blocks, held = _blocks(work, parts, [column.kind for column in columns], counts), None
    if isinstance(parts, _Memory):
        held = tuple(np.concatenate(local) for local in zip(*blocks, strict=True))
        blocks = ([column[at : at + BLOCK] for column in held] for at in range(0, grid.points, BLOCK))
    if out is not None:
        write_table(out, columns, blocks, made_of)
    if isinstance(parts, SweepParts):
        parts.remove()
    return Sweep(system.name, of, grid, columns, held, *counts, out, made_of, notes)


def part_points(points: int, *, quick: bool) -> int:
    """Return how many points are a part of the work.

    Parameters
    ----------
    points
        Of the whole sweep.
    quick
        As of `quantities.SweepQuantity`.
    """
    most = min(points // SHARES, QUICK_POINTS) if quick else 0
    return max(PART_POINTS, most, -(-points // MOST_PARTS))


def _description(system: Model, work: Work) -> dict[str, Any]:
    """Return the description of a sweep, as plain data: two with the same description have the same rows."""
    parameters = {parameter.name: parameter.value for parameter in system.parameters}
    parameters |= {timing.name: float(timing.value) for timing in system.timings}
    varied = [axis.free for axis in work.grid.axes]
    parameters |= {
        f"{group.name}.{value.name}": value.value for group in system.groups for value in group.values
    }
    return {
        "topology": system.name,
        "peers": system.peers,
        "of": work.of,
        "limitations": [
            *near_start(system),
            *limitations(system, network=not work.of.startswith(BEGINNINGS[MEAN_SQUARE]), varied=varied),
            *notes_for_all_groups(system, varied),
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
        "texts": dict(system.origin.digests),
        "model": hashlib.sha256(work.model).hexdigest(),
        "part_points": work.part_points,
        "versions": dict(program_versions()),
    }


class _Memory:
    """Parts that are nowhere but here, as `finished_parts.SweepParts` are on disk."""

    def __init__(self) -> None:
        self._cells: dict[int, Cells] = {}

    def write(self, part: int, cells: Cells) -> None:
        self._cells[part] = cells

    def read(self, part: int) -> Cells | None:
        return self._cells.get(part)

    def finished(self) -> set[int]:
        return set(self._cells)


_Stored = SweepParts | _Memory


def _in_a_file(out: Path | None) -> bool:
    """Say whether rows stand in a file that can be read again."""
    return out is not None and not is_special(out)


def _stored(out: Path | None, made_of: Mapping[str, Any]) -> _Stored:
    return open_parts(out, made_of) if out is not None and _in_a_file(out) else _Memory()


@dataclass(frozen=True, slots=True)
class Whose:
    """Who computes: so many processes here, or a cluster at this address; and the patience with them."""

    jobs: int
    cluster: str | None
    patience: Patience


def _compute_missing(work: Work, stored: _Stored, whose: Whose, progress: Progress | None) -> tuple[str, ...]:
    """Compute the missing parts, store each at once, and return remarks on the computation."""
    there = stored.finished()
    missing = [part for part in range(work.parts) if part not in there or stored.read(part) is None]
    damaged = [part for part in missing if part in there]
    done = work.grid.points - sum(len(work.points_of(part)) for part in missing)
    repeated = "was damaged, or written by somebody else, and is computed again"
    notes = [f"part {part} {repeated}" for part in damaged]
    if done:
        notes.append(f"{done:,} points were there already")
    if progress:
        progress(done, work.grid.points)
    if not missing:
        return tuple(notes)
    with _workers(work, min(whose.jobs, len(missing)), whose.cluster) as workers:
        for computed in results(workers, missing, whose.patience, LOCATION):
            if computed.versions != program_versions():
                raise ApcError(_other_versions(computed, whose.cluster))
            stored.write(computed.part, computed.cells)
            done += len(work.points_of(computed.part))
            if progress:
                progress(done, work.grid.points)
    return tuple(notes)


def _workers(work: Work, jobs: int, cluster: str | None) -> AbstractContextManager[Workers[int, Computed]]:
    if cluster is not None:
        from apc.sweeps.cluster import cluster_workers

        return cluster_workers(compute_part, work, cluster)
    if jobs == 1:
        return nullcontext(this_process(compute_part, work))
    return local_processes(compute_part, work, jobs, LOST)


def _other_versions(computed: Computed, cluster: str | None) -> Diagnostic:
    """Return the message for numbers that come from other libraries than those here."""
    here = dict(program_versions())
    other = [f"{name} {got} (here {here[name]})" for name, got in computed.versions if here[name] != got]
    message = f"a worker has {', '.join(other)}: the same numbers can't be promised; install the same there"
    return Diagnostic("E888", SourceLocation(cluster or "sweep"), message)


def _blocks(
    work: Work, stored: _Stored, kinds: Sequence[str], counts: tuple[Counter[str], Counter[str]]
) -> Iterator[list[NDArray[Any]]]:
    """Yield the rows as blocks of columns, the values of the axes first; count the verdicts and messages."""
    values = [np.array([float(value) for value in axis.values]) for axis in work.grid.axes]
    waiting: list[list[NDArray[Any]]] = []
    rows = 0
    for number in range(work.parts):
        cells = stored.read(number)
        if cells is None:  # another process with the same sweep was done, and removed it
            cells = compute_part(work, number).cells
        indices = work.grid.indices(work.points_of(number))
        columns = [value[indices[:, axis]] for axis, value in enumerate(values)] + list(cells)
        counts[0].update(cells[0].tolist())
        counts[1].update(cells[-1].tolist())
        waiting.append(
            [
                _counts(column) if kind == "count" else column
                for column, kind in zip(columns, kinds, strict=True)
            ]
        )
        rows += len(indices)
        while rows >= BLOCK or (rows and number == work.parts - 1):
            whole = [np.concatenate(local) for local in zip(*waiting, strict=True)]
            yield [values[:BLOCK] for values in whole]
            rows = max(rows - BLOCK, 0)
            waiting = [[values[BLOCK:] for values in whole]]


def _counts(numbers: NDArray[np.float64]) -> NDArray[Any]:
    """Return whole numbers as integers, None where there is none."""
    nothing = np.isnan(numbers)
    cells = np.where(nothing, 0.0, numbers).astype(np.int64).astype(object)
    cells[nothing] = None
    return cells
