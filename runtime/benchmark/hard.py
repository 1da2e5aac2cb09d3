"""The hard cases: topologies with a reference of fifty digits, compared with their analyses.

Takes: a folder of topologies and its `truths.json`.
Gives: `HardCase`, `HardReport`, `run_hard_cases`.
Guarantees: an error is computed exactly from the stored digits; a violated or infinite bound, a wrong or
undecided verdict and a wrong number of rigid modes are failures.
Does not: compute references (see the script in the folder of the topologies).
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

from apc.analysis.analysis import Analysis
from apc.benchmark.speed_and_error import analysis_of
from apc.benchmark.timing import median_time
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import RefusedError, read_file
from apc.compiler.pipeline import compile_topology
from apc.compiler.source.nodes import MAX_BYTES
from apc.result import Result
from apc.support.threads import single_threaded
from apc.verdict import StabilityVerdict

TRUTHS = "truths.json"
FOLDER = "--hard tests/hard"
REPEATS = 3  # runs of each analysis, of which the median time is used
ENOUGH = 2.0  # seconds after which an analysis is not repeated


@dataclass(frozen=True, slots=True)
class HardCase:
    """One topology: the analysis compared with the reference.

    `error` is |ρ − reference|, `bound` the error bound of the analysis, both divided by max(ρ, 1) of the
    reference. `seconds` is the median time of the analysis. `undecided` is whether the verdict is undecided.
    `failed` is the text of the failure, "" if none: no bound and no verdict are failures too, since the
    reference is known.
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
        """The ratio of bound to error, infinite for an error of zero."""
        return self.bound / self.error if self.error else math.inf

    @property
    def unbounded(self) -> bool:
        """Whether the bound is infinite."""
        return not math.isfinite(self.bound)


@dataclass(frozen=True, slots=True)
class HardReport(Result):
    """All cases of a folder; `without` are its topologies without a reference."""

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
    solve: Callable[[Model], Analysis] = analysis_of,
) -> HardReport:
    """Return the comparison of the analyses of all topologies in a folder with their references.

    Parameters
    ----------
    folder
        A folder with topologies and `truths.json`, which has by file name without suffix `spectral_radius`
        (text, many digits), `rigid_modes`, `verdict`.
    repeats
        The number of analyses of each topology, of which the median time is used.
    solve
        The function that analyzes a model.

    Raises
    ------
    ApcError
        E920 the folder or its references are missing or invalid; and the errors of compilation and
        analysis.
    """
    truths = _truths(folder)
    cases, without = [], []
    for path in sorted(folder.glob("*.yaml")):
        if path.stem not in truths:
            without.append(path.name)
            continue
        model = compile_topology(path)
        with single_threaded():
            seconds, result = median_time(partial(solve, model), repeats, enough=ENOUGH)
        cases.append(compare(model, result, truths[path.stem], seconds, path.stem))
    if not cases:
        message = "has no topology with a reference result"
        raise ApcError(Diagnostic("E920", SourceLocation(str(folder)), message, fix=FOLDER))
    return HardReport(str(folder), tuple(cases), tuple(without))


def compare(
    model: Model, analysis: Analysis, truth: Mapping[str, Any], seconds: float, name: str
) -> HardCase:
    """Return the comparison of an analysis with its reference.

    Parameters
    ----------
    model, analysis
        The topology and its analysis.
    truth
        An entry of `truths.json`.
    seconds
        The time of the analysis.
    name
        The name of the case.
    """
    radius = Fraction(truth["spectral_radius"])
    bound = analysis.spectral_radius_error
    deviation = None
    if math.isfinite(analysis.spectral_radius):
        deviation = abs(Fraction(analysis.spectral_radius) - radius)
    size = float(max(radius, Fraction(1)))
    failures = []
    if deviation is None:
        failures.append("no spectral radius")
    elif not math.isfinite(bound):
        failures.append("the bound is infinite")
    elif deviation > Fraction(bound):
        failures.append("the bound does not hold")
    if analysis.stable is None:
        failures.append(f"the verdict is undecided; expected: {truth['verdict']}")
    elif analysis.verdict != truth["verdict"]:
        failures.append(f"the verdict is wrong: {truth['verdict']}")
    if analysis.rigid_modes != truth["rigid_modes"]:
        failures.append(f"{truth['rigid_modes']} rigid modes, not {analysis.rigid_modes}")
    return HardCase(
        name=name,
        description=model.description,
        peers=model.peers,
        method=analysis.method + (" + proof" if analysis.proof else ""),
        verdict=analysis.verdict,
        radius=str(truth["spectral_radius"]),
        error=math.inf if deviation is None else float(deviation) / size,
        bound=bound / size,
        seconds=seconds,
        undecided=analysis.stable is None,
        failed="; ".join(failures),
    )


def _truths(folder: Path) -> dict[str, Any]:
    """Return the references of a folder by file name.

    Raises ApcError (E920) for missing or invalid references.
    """
    path = folder / TRUTHS
    location = SourceLocation(str(path))
    try:
        result = json.loads(read_file(path, MAX_BYTES))
    except RefusedError as refused:
        raise ApcError(Diagnostic("E920", location, refused.words, fix=FOLDER)) from None
    except ValueError as error:
        raise ApcError(Diagnostic("E920", location, f"invalid JSON: {error}")) from error
    pairs: list[tuple[str, Any]] = list(result.items()) if isinstance(result, dict) else [("", None)]
    for name, truth in pairs:
        try:
            Fraction(truth["spectral_radius"])
            is_valid = isinstance(truth["rigid_modes"], int) and isinstance(truth["verdict"], str)
            if not is_valid:
                raise TypeError
        except (TypeError, KeyError, ValueError, ArithmeticError) as error:
            expected = "spectral_radius (digits), rigid_modes and verdict of each topology"
            raise ApcError(
                Diagnostic("E920", location, name or "reference results", expected, "something else")
            ) from error
    return dict(result)
