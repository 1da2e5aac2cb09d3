"""The hard cases: topologies whose truth is known to fifty digits, each analysed and compared with it.

Takes: a folder of topologies and its `truths.json`.
Gives: `HardCase`, `HardReport`, `run_hard_cases`.
Guarantees: an error is computed exactly from the stored digits; a bound that does not hold or says nothing, a
verdict that is wrong or left open and a wrong number of rigid modes fail.
Does not: compute any truth (see the script beside the topologies).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

from apc.analysis.analysis import Analysis, analyze
from apc.benchmark.timing import median_time
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import RefusedError, read_file
from apc.compiler.pipeline import compile_topology
from apc.compiler.source.nodes import MAX_BYTES
from apc.result import Result
from apc.threads import single_threaded
from apc.verdict import StabilityVerdict

TRUTHS = "truths.json"
FOLDER = "--hard FOLDER, of topologies and their truths, as tests/hard of a copy of the repository"
REPEATS = 3  # of each analysis; its time is the median
ENOUGH = 2.0  # seconds after which one is not repeated


@dataclass(frozen=True, slots=True)
class HardCase:
    """One topology: the answer beside the truth.

    `error` is |ρ − truth|, `bound` the error bound of the analysis, both divided by max(ρ, 1) where ρ
    is the truth. `seconds` is the median time of the analysis. `undecided` says that it left the verdict
    open. `failed` is the failure, "" if none: no bound and no verdict are failures too, since the
    truth is known.
    """

    name: str
    description: str
    peers: int
    method: str
    verdict: StabilityVerdict
    radius: str
    error: float
    bound: float
    seconds: float
    undecided: bool
    failed: str

    @property
    def looseness(self) -> float:
        """Bound ÷ error; infinite where there is no error."""
        return self.bound / self.error if self.error else math.inf

    @property
    def unbounded(self) -> bool:
        """Whether the bound says nothing."""
        return not math.isfinite(self.bound)


@dataclass(frozen=True, slots=True)
class HardReport(Result):
    """All cases of a folder, and its topologies without a truth."""

    shown_by = "bench_output:hard"

    folder: str
    cases: tuple[HardCase, ...]
    without: tuple[str, ...]

    @property
    def failures(self) -> tuple[HardCase, ...]:
        """The cases that failed."""
        return tuple(case for case in self.cases if case.failed)


def run_hard_cases(
    folder: Path,
    *,
    repeats: int = REPEATS,
    solve: Callable[[Model], Analysis] = analyze,
) -> HardReport:
    """Analyse every topology of a folder and compare.

    Parameters
    ----------
    folder
        Holds topologies and `truths.json`: by the name of a file without its suffix, `spectral_radius` (text,
        many digits), `rigid_modes`, `verdict`.
    repeats
        Analyses of each topology, of which the median time counts.
    solve
        The analysis.

    Raises
    ------
    ApcError
        E920 no such folder, no truths in it or truths that can't be read; and those of compiling and
        analysing.
    """
    truths = _truths(folder)
    cases, without = [], []
    for path in sorted(folder.glob("*.yaml")):
        if path.stem not in truths:
            without.append(path.name)
            continue
        system = compile_topology(path)
        with single_threaded():
            seconds, result = median_time(partial(solve, system), repeats, enough=ENOUGH)
        cases.append(compare(system, result, truths[path.stem], seconds, path.stem))
    if not cases:
        message = "holds no topology whose truth is known"
        raise ApcError(Diagnostic("E920", SourceLocation(str(folder)), message, hint=FOLDER))
    return HardReport(str(folder), tuple(cases), tuple(without))


def compare(
    system: Model, analysis: Analysis, truth: Mapping[str, Any], seconds: float, name: str
) -> HardCase:
    """Compare an analysis with the truth.

    Parameters
    ----------
    system, analysis
        The topology and its analysis.
    truth
        An entry of `truths.json`.
    seconds
        What it took.
    name
        The name of the case.
    """
    radius = Fraction(truth["spectral_radius"])
    bound = analysis.spectral_radius_error
    separation = None
    if math.isfinite(analysis.spectral_radius):
        separation = abs(Fraction(analysis.spectral_radius) - radius)
    size = float(max(radius, Fraction(1)))
    wrong = []
    if separation is None:
        wrong.append("there is no spectral radius")
    elif not math.isfinite(bound):
        wrong.append("the bound says nothing")
    elif separation > Fraction(bound):
        wrong.append("the bound does not hold")
    if analysis.stable is None:
        wrong.append(f"the verdict is left open: {truth['verdict']}")
    elif analysis.verdict != truth["verdict"]:
        wrong.append(f"the verdict is wrong: {truth['verdict']}")
    if analysis.rigid_modes != truth["rigid_modes"]:
        wrong.append(f"{truth['rigid_modes']} rigid modes, not {analysis.rigid_modes}")
    return HardCase(
        name=name,
        description=system.description,
        peers=system.peers,
        method=analysis.method + (" + proof" if analysis.proof else ""),
        verdict=analysis.verdict,
        radius=str(truth["spectral_radius"]),
        error=math.inf if separation is None else float(separation) / size,
        bound=bound / size,
        seconds=seconds,
        undecided=analysis.stable is None,
        failed="; ".join(wrong),
    )


def _truths(folder: Path) -> dict[str, Any]:
    """Read the truths of a folder."""
    path = folder / TRUTHS
    location = SourceLocation(str(path))
    try:
        result = json.loads(read_file(path, MAX_BYTES))
    except RefusedError as refused:
        raise ApcError(Diagnostic("E920", location, refused.words, hint=FOLDER)) from None
    except ValueError as error:
        raise ApcError(Diagnostic("E920", location, f"is not JSON: {error}")) from error
    pairs: list[tuple[str, Any]] = list(result.items()) if isinstance(result, dict) else [("", None)]
    for name, truth in pairs:
        try:
            Fraction(truth["spectral_radius"])
            whole = isinstance(truth["rigid_modes"], int) and isinstance(truth["verdict"], str)
            if not whole:
                raise TypeError
        except (TypeError, KeyError, ValueError, ArithmeticError) as error:
            expected = "spectral_radius (digits), rigid_modes and verdict of each topology"
            raise ApcError(
                Diagnostic("E920", location, name or "the truths", expected, "something else")
            ) from error
    return dict(result)
