"""One result at every combination of some parameters' values, with what is finished kept as it comes.

Takes: a `CompiledSystem`, the values of each swept parameter, what to compute.
Gives: `Sweep`, `sweep`; `part_points`.
Guarantees: the same rows in the same order whoever computes them, interrupted or not; a sweep with a target
takes up its finished parts; the target is written when all of it is there, and its parts are removed then.
Does not: start processes itself (see `processes`, `cluster`), or print.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.files import is_special
from apc.compiler.frozen import dataclass
from apc.compiler.timings import part
from apc.frame.ages import linear_sites
from apc.frame.names import notes_for_all_groups
from apc.memory import refuse_beyond
from apc.network.nominal import left_out, refuse_channel_number
from apc.processes import Patience, Workers, cores, local_processes, model_bytes, results, this_process
from apc.result import Result
from apc.sweeps.grid import Grid, build_grid, check_size, parse_axis
from apc.sweeps.quantities import BEGINNINGS, VERDICT, by_criterion, find_quantity
from apc.sweeps.store import Parts, open_parts, remove_parts
from apc.sweeps.work import Computed, Work, compute_part, program_versions
from apc.tables import BLOCK, Cell, Column, Row, check_table_path, write_table
from apc.vary.growth import MEAN_SQUARE, NOMINAL, PASSIVE, criterion_of, refuse_time

if TYPE_CHECKING:
    import pandas

PLACE = Place("sweep")

# Points of a part: a third of a second of analyses, which is what a kill can cost; more where points are
# quick, as long as there are parts for all who compute; and no more files in a folder than one likes to list.
PART_POINTS, QUICK_POINTS = 64, 2048
SHARES = 32
MOST_PARTS = 10_000

Progress = Callable[[int, int], None]  # points done, points in all

LOST = Mistake(
    "E889",
    PLACE,
    "a process that computed ended without a word: stopped from outside, out of memory, or started by a "
    "script that sweeps when it is imported",
    hint="--jobs 1; in a script, if __name__ == '__main__': around the sweep",
)


@dataclass(frozen=True, slots=True, eq=False)
class Sweep(Result):
    """The rows of a sweep, by columns: swept parameters first, in SI, then results.

    A column of numbers is a float64 array (n,), NaN where a point has no number; others are object arrays.
    `made_of` says what made it: model, axes, versions. `notes` tell what was out of the ordinary.
    """

    shown_by = "vary:sweep"

    topology: str
    of: str
    grid: Grid
    headings: tuple[str, ...]
    columns: tuple[NDArray[Any], ...]
    out: Path | None
    made_of: Mapping[str, Any]
    notes: tuple[str, ...]

    @property
    def points(self) -> int:
        """The number of rows."""
        return self.grid.points

    def column(self, heading: str) -> NDArray[Any]:
        """Return the column of a heading, such as `verdict` or `contact.stiffness [N/m]`."""
        return self.columns[self.headings.index(heading)]

    @property
    def verdicts(self) -> tuple[tuple[str, int], ...]:
        """Each verdict and how many points have it, the most frequent first."""
        counts = Counter(self.column(VERDICT.heading).tolist())
        return tuple(sorted(counts.items(), key=lambda item: (-item[1], item[0])))

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the sweep as a pandas table, with the headings as its columns."""
        table: pandas.DataFrame = self._shown("table")
        return table


NUMBER, CELL = 16, 150  # bytes of a cell in a column; and where no file keeps the rows


@part("points")
def sweep(
    system: CompiledSystem,
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
        The compiled scene; its numbers hold for what is not swept.
    over
        The values of each swept parameter by its name: a range `"0 N/m:3000 N/m:31"` (`LOW:HIGH:COUNT`, and
        `:log` for equal ratios), or a list, `"0,8 ms"` or `["0 ms", "8 ms"]`. The last one turns fastest.
    of
        What to compute, see `quantities.QUANTITIES`: `analyze`, …
    criterion
        "mean-square" or "nominal", see `critical.critical`.
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
        E885 other work stands at the target; E878, E887 or E601 the target can't be written; E888 the
        cluster; E889 a process ended, or nothing came for too long. What is finished is kept.
    """
    texts = {name: text if isinstance(text, str) else ",".join(text) for name, text in over.items()}
    check_size(list(texts.values()))
    grid = build_grid([parse_axis(system, name, text) for name, text in texts.items()])
    meant = criterion_of(system, criterion, PLACE, [axis.free for axis in grid.axes])
    work_of = by_criterion(of, meant)
    quantity = find_quantity(system, work_of)
    for axis in grid.axes:
        if meant == PASSIVE:
            refuse_time(system, axis.free, PLACE, meant)
        if meant == NOMINAL:
            refuse_channel_number(system, axis.free, PLACE, instead=f"--in {MEAN_SQUARE}")
        if axis.free.label == of.partition(":")[2].strip():
            what = f"{axis.free.label} is swept: there is nothing to look for at one value of it"
            raise ApcError(Mistake("E884", PLACE, what, hint="--of critical:PATH with another parameter"))
    if out is not None:
        check_table_path(out, "out=")
    if jobs is not None and jobs < 1:
        raise ApcError(Mistake("E889", PLACE, "the number of processes", "1 or more", str(jobs)))
    width = len(grid.axes) + len(quantity.columns)
    what = f"{grid.points:,} points of {width} columns"
    needed = grid.points * width * (NUMBER if out else CELL)
    refuse_beyond(needed, "E883", PLACE, what, "fewer values" if out else "fewer values, or out=FILE.parquet")
    work = Work(model_bytes(system), work_of, grid, part_points(grid.points, quick=quantity.quick))
    made_of = _description(system, work)
    with _kept(out, made_of) as kept:
        whose = Whose(jobs or cores(), cluster, patience or Patience())
        notes = _compute_missing(work, kept, whose, progress)
        listed = (*(Column(axis.heading) for axis in grid.axes), *quantity.columns)
        kinds = [one.kind for one in listed]
        columns: tuple[NDArray[Any], ...] = tuple(
            np.empty(grid.points, dtype=np.float64 if kind == "number" else object) for kind in kinds
        )
        _collect(work, kept, kinds, columns)
        if out is not None:
            starts = range(0, grid.points, BLOCK)
            blocks = ([column[at : at + BLOCK] for column in columns] for at in starts)
            write_table(out, listed, blocks, made_of)
            if isinstance(kept, Parts):
                remove_parts(out)
    headings = tuple(one.heading for one in listed)
    return Sweep(system.name, of, grid, headings, columns, out, made_of, notes)


def part_points(points: int, *, quick: bool) -> int:
    """Return how many points are a part of the work.

    Parameters
    ----------
    points
        Of the whole sweep.
    quick
        As of `quantities.Quantity`.
    """
    most = min(points // SHARES, QUICK_POINTS) if quick else 0
    return max(PART_POINTS, most, -(-points // MOST_PARTS))


def _description(system: CompiledSystem, work: Work) -> dict[str, Any]:
    """Return what a sweep is, as plain data: two with the same description have the same rows."""
    parameters = {one.name: one.value for one in system.parameters}
    parameters |= {one.name: float(one.value) for one in system.timings}
    parameters |= {f"{group.name}.{one.name}": one.value for group in system.groups for one in group.values}
    return {
        "topology": system.name,
        "peers": system.peers,
        "of": work.of,
        "left_out": [
            *left_out(
                system,
                linear=all(site.affine for site in linear_sites(system)),
                network=not work.of.startswith(BEGINNINGS[MEAN_SQUARE]),
            ),
            *notes_for_all_groups(system, [axis.free for axis in work.grid.axes]),
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
        "texts": dict(system.origin.texts),
        "model": hashlib.sha256(work.model).hexdigest(),
        "part_points": work.part_points,
        "versions": dict(program_versions()),
    }


class _Memory:
    """Parts that are nowhere but here, as `store.Parts` are on disk."""

    def __init__(self) -> None:
        self._rows: dict[int, tuple[Row, ...]] = {}

    def write(self, part: int, rows: tuple[Row, ...]) -> None:
        self._rows[part] = rows

    def read(self, part: int) -> tuple[Row, ...] | None:
        return self._rows.get(part)

    def there(self) -> set[int]:
        return set(self._rows)


_Kept = Parts | _Memory


@contextmanager
def _kept(out: Path | None, made_of: Mapping[str, Any]) -> Iterator[_Kept]:
    if out is None or is_special(out):
        yield _Memory()
        return
    with open_parts(out, made_of) as parts:
        yield parts


@dataclass(frozen=True, slots=True)
class Whose:
    """Who computes: so many processes here, or a cluster at this address; and the patience with them."""

    jobs: int
    cluster: str | None
    patience: Patience


def _compute_missing(work: Work, kept: _Kept, whose: Whose, progress: Progress | None) -> tuple[str, ...]:
    """Compute the parts that aren't there, keep each as it comes, and return what to tell of it."""
    there = kept.there()
    missing = [part for part in range(work.parts) if part not in there or kept.read(part) is None]
    damaged = [part for part in missing if part in there]
    done = work.grid.points - sum(len(work.points_of(part)) for part in missing)
    notes = [f"part {part} was damaged and is computed again" for part in damaged]
    if done:
        notes.append(f"{done:,} points were there already")
    if progress:
        progress(done, work.grid.points)
    if not missing:
        return tuple(notes)
    with _workers(work, min(whose.jobs, len(missing)), whose.cluster) as workers:
        for computed in results(workers, missing, whose.patience, PLACE):
            if computed.versions != program_versions():
                raise ApcError(_other_versions(computed, whose.cluster))
            kept.write(computed.part, computed.rows)
            done += len(computed.rows)
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


def _other_versions(computed: Computed, cluster: str | None) -> Mistake:
    """Return the message for numbers that come from other libraries than those here."""
    here = dict(program_versions())
    other = [f"{name} {got} (here {here[name]})" for name, got in computed.versions if here[name] != got]
    what = f"a worker has {', '.join(other)}: the same numbers can't be promised; install the same there"
    return Mistake("E888", Place(cluster or "sweep"), what)


def _collect(work: Work, kept: _Kept, kinds: Sequence[str], columns: Sequence[NDArray[Any]]) -> None:
    """Fill in the columns: the values of the axes, then the results."""
    values = [np.array([float(value) for value in axis.values]) for axis in work.grid.axes]
    words: dict[Cell, Cell] = {}  # a verdict that stands in a million rows is held once
    for number in range(work.parts):
        computed = kept.read(number)
        assert computed is not None, f"part {number} was written and is gone"
        points = work.points_of(number)
        places = work.grid.places(points)
        listed: list[Any] = [own[places[:, axis]] for axis, own in enumerate(values)]
        listed += list(zip(*computed, strict=True))
        for column, cells, kind in zip(columns, listed, kinds, strict=True):
            if kind == "number":  # None is NaN
                column[points.start : points.stop] = np.array(cells, dtype=np.float64)
            else:
                column[points.start : points.stop] = [words.setdefault(cell, cell) for cell in cells]
