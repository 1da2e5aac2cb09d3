"""The cost of the number of peers: time, memory and error.

Takes: a topology file and the numbers of peers.
Gives: `Scale`, `ScaleRow`, `scale`.
Guarantees: each number of peers is measured in a separate process, so that its memory is measured separately.
Does not: change the file: the count of the largest group with a written `count` is changed in memory only.
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

from apc.benchmark.speed_and_error import analysis_of, reason_of
from apc.benchmark.timing import median_time, timed
from apc.benchmark.truth import spectral_truth
from apc.compiler.compiled import LARGEST_COUNT, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.pipeline import stages_of
from apc.compiler.source.nodes import Mapping, Scalar
from apc.compiler.source.source import parse_source, read_source
from apc.compiler.wording import counted
from apc.result import Result
from apc.support.not_supported import NotSupportedError
from apc.support.processes import Patience, local_processes, results
from apc.verdict import StabilityVerdict

Measured = TypeVar("Measured")

REPEATS = 3  # runs of each analysis, of which the median time is used


@dataclass(frozen=True, slots=True)
class ScaleRow:
    """The measurement for one number of peers: seconds of compilation and analysis, largest memory in
    bytes, error.

    `count` is the number of peers of the varied group, `peers` of the topology; `error` and `bound` are of
    the spectral radius.
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
    """One row for each number of peers; `refused` are the numbers that can't be analyzed, with the reason.

    `floor` is the text for the memory of the program itself.
    """

    shown_by = "bench_output:scale"

    topology: str
    group: str
    rows: tuple[ScaleRow, ...]
    refused: tuple[tuple[int, str], ...]
    floor: str


def scale(path: Path, counts: Sequence[int]) -> Scale:
    """Return time, memory and error of a topology with other numbers of peers.

    Parameters
    ----------
    path
        The topology.
    counts
        The numbers of peers of the varied group; each is measured once.

    Raises
    ------
    ApcError
        E921 no group has a written count, a number is invalid, or none can be analyzed; and the errors of
        compilation.
    """
    if not counts or min(counts) < 1 or max(counts) > LARGEST_COUNT:
        expected = f"numbers from 1 to {LARGEST_COUNT:,}, such as 3,30,300"
        got = ",".join(map(str, counts))[:80]
        raise ApcError(Diagnostic("E921", SourceLocation("--scale"), "list", expected, got))
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
        message = f"{counted(count, 'peer')} of {name} can't be measured: {reason}"
        raise ApcError(Diagnostic("E921", SourceLocation("--scale"), message))
    text = f"including {floor / 2**20:.0f} MiB of the program itself"
    return Scale(path.stem, name, tuple(rows), tuple(refused), text)


def with_count(path: Path, count: int) -> Model:
    """Return the model of a topology whose largest group has another number of peers."""
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
    *_, (_, model) = stages_of(changed)
    assert isinstance(model, Model)
    return model


def _largest(path: Path) -> tuple[str, Scalar]:
    """Return the largest group with a written count, and the node of the count. Raises ApcError (E921)."""
    root = read_source(path).root
    groups = root.get("peers") if isinstance(root, Mapping) else None
    result: list[tuple[int, str, Scalar]] = []
    for key, value in groups.entries if isinstance(groups, Mapping) else ():
        number = value.get("count") if isinstance(value, Mapping) else None
        if isinstance(number, Scalar) and isinstance(number.value, int):
            result.append((number.value, key.text, number))
    if not result:
        message = "no group of this topology has a count that can be varied"
        raise ApcError(
            Diagnostic("E921", SourceLocation(str(path)), message, fix="peers: {user: {count: 3}}")
        )
    _, name, number = max(result, key=lambda item: item[0])
    return name, number


def _measure_in_process(measure: Callable[[Path, int], Measured], path: Path, count: int) -> Measured:
    """Return the result of a measurement in a separate process."""
    location = SourceLocation("--scale")
    message = "the measuring process exited unexpectedly: stopped, or out of memory"
    with local_processes(measure, path, 1, Diagnostic("E921", location, message)) as workers:
        return next(results(workers, [count], Patience(), location))


def _measure(path: Path, count: int) -> ScaleRow:
    """Return the measurement of compilation and analysis for one number of peers, in this process."""
    compiled, model = timed(partial(with_count, path, count))
    analyzed, result = median_time(partial(analysis_of, model), REPEATS)
    memory = _memory()
    error = None
    with suppress(NotSupportedError):
        error = spectral_truth(model).error_of(result.spectral_radius)
    return ScaleRow(
        count=count,
        peers=model.peers,
        compile_s=compiled,
        analyze_s=analyzed,
        memory=memory,
        error=error,
        bound=result.spectral_radius_error,
        method=result.method,
        verdict=result.verdict,
    )


def _floor(_path: Path, _count: int) -> int:
    """Return the memory of a process without a model, in bytes."""
    return _memory()


def _memory() -> int:
    """Return the largest memory of this process so far, in bytes."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024
