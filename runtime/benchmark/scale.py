"""The cost of the number of peers: time, memory and error.

Takes: a topology file and the numbers of peers.
Gives: `Scale`, `ScaleRow`, `scale`.
Guarantees: each number is measured in a process of its own, so that memory is its own.
Does not: change the file; the group with the most peers of a written `count` grows in memory only.
"""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from apc.analysis.analysis import analyze
from apc.benchmark.speed_and_error import reason_of
from apc.benchmark.timing import median_time, timed
from apc.benchmark.truth import spectral_truth
from apc.compiler.compiled import LARGEST_COUNT, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.pipeline import stages_of
from apc.compiler.source.nodes import Mapping, Scalar
from apc.compiler.source.source import parse_source, read_source
from apc.compiler.wording import counted
from apc.not_supported import NotSupportedError
from apc.processes import Patience, local_processes, results
from apc.result import Result
from apc.verdict import StabilityVerdict

Found = TypeVar("Found")

REPEATS = 3  # of each analysis; its time is the median


@dataclass(frozen=True, slots=True)
class ScaleRow:
    """One number of peers: seconds to compile and analyse, bytes at most, the error of the radius.

    `count` is of the group that grows, `peers` of the whole topology.
    """

    count: int
    peers: int
    compile_s: float
    analyze_s: float
    memory: int
    error: float | None
    bound: float
    method: str
    verdict: StabilityVerdict


@dataclass(frozen=True, slots=True)
class Scale(Result):
    """A row a number; `refused` are the numbers that can't be analysed, with the reason.

    `floor` says how much memory the program takes by itself.
    """

    shown_by = "bench_output:scale"

    topology: str
    group: str
    rows: tuple[ScaleRow, ...]
    refused: tuple[tuple[int, str], ...]
    floor: str


def scale(path: Path, counts: Sequence[int]) -> Scale:
    """Compile and analyse a topology with other numbers of peers.

    Parameters
    ----------
    path
        The topology.
    counts
        How many peers the group that grows has; each is measured once.

    Raises
    ------
    ApcError
        E921 no group has a written count, a number is none, or none of them can be analysed; and those of
        compiling.
    """
    if not counts or min(counts) < 1 or max(counts) > LARGEST_COUNT:
        expected = f"numbers from 1 to {LARGEST_COUNT:,}, like 3,30,300"
        got = ",".join(map(str, counts))[:80]
        raise ApcError(Diagnostic("E921", SourceLocation("--scale"), "the list", expected, got))
    name, _ = _largest(path)
    rows, refused = [], []
    floor = _measure_in_process(_floor, path, 0)
    for count in dict.fromkeys(counts):
        try:
            rows.append(_measure_in_process(_measure, path, count))
        except ApcError as error:
            refused.append((count, reason_of(error)))
    if not rows:
        count, reason = refused[0]
        message = f"leaves nothing to measure: {counted(count, 'peer')} of {name}: {reason}"
        raise ApcError(Diagnostic("E921", SourceLocation("--scale"), message))
    text = f"{floor / 2**20:.0f} MiB are the program itself"
    return Scale(path.stem, name, tuple(rows), tuple(refused), text)


def with_count(path: Path, count: int) -> Model:
    """Compile a topology whose largest group has another number of peers."""
    source = read_source(path)
    _, number = _largest(path)
    lines = source.text.splitlines(keepends=True)
    location = number.location
    line = lines[location.line - 1]
    assert line[location.column - 1 :].startswith(number.text)
    lines[location.line - 1] = (
        line[: location.column - 1] + str(count) + line[location.column - 1 + len(number.text) :]
    )
    changed = parse_source("".join(lines).encode(), file=source.file, path=source.path)
    *_, (_, system) = stages_of(changed)
    assert isinstance(system, Model)
    return system


def _largest(path: Path) -> tuple[str, Scalar]:
    """Return the group with the most peers of a written count, and where that stands."""
    root = read_source(path).root
    groups = root.get("peers") if isinstance(root, Mapping) else None
    result: list[tuple[int, str, Scalar]] = []
    for key, value in groups.entries if isinstance(groups, Mapping) else ():
        number = value.get("count") if isinstance(value, Mapping) else None
        if isinstance(number, Scalar) and isinstance(number.value, int):
            result.append((number.value, key.text, number))
    if not result:
        message = "no group of this topology has a count that could grow"
        raise ApcError(
            Diagnostic("E921", SourceLocation(str(path)), message, hint="peers: {user: {count: 3}}")
        )
    _, name, number = max(result, key=lambda item: item[0])
    return name, number


def _measure_in_process(measure: Callable[[Path, int], Found], path: Path, count: int) -> Found:
    """Measure in a process of its own."""
    location = SourceLocation("--scale")
    message = "the process that measured it ended without a word: stopped from outside, or out of memory"
    with local_processes(measure, path, 1, Diagnostic("E921", location, message)) as workers:
        return next(results(workers, [count], Patience(), location))


def _measure(path: Path, count: int) -> ScaleRow:
    """Compile and analyse, in this process."""
    compiled, system = timed(partial(with_count, path, count))
    analyzed, result = median_time(partial(analyze, system), REPEATS)
    memory = _memory()
    error = None
    with suppress(NotSupportedError):
        error = spectral_truth(system).error_of(result.spectral_radius)
    return ScaleRow(
        count=count,
        peers=system.peers,
        compile_s=compiled,
        analyze_s=analyzed,
        memory=memory,
        error=error,
        bound=result.spectral_radius_error,
        method=result.method,
        verdict=result.verdict,
    )


def _floor(_path: Path, _count: int) -> int:
    return _memory()


def _memory() -> int:
    """Return the most bytes this process has held."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024
