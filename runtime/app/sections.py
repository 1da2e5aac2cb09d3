"""The result of each section of the page, computed in a worker process.

Takes: a compiled model as bytes, and a `Task`: a section, the changed parameters, its options.
Gives: `Task`, `SectionAnswer`, `compute`; `SECTIONS`.
Guarantees: every number is from a function of the public API. A section without a result has a text with the
reason; errors are reported as in `apc`.
Does not: handle the browser, or store results.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Any

import numpy as np

from apc.analysis.analysis import Analysis, analyze, prepare_at_start
from apc.app.motion import motion_of
from apc.app.sliders import text_of
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.wording import in_hertz
from apc.eigen.spectrum import Mode
from apc.frame.evaluation_errors import finite_equations
from apc.frame.numeric_model import Prepared, prepare
from apc.frame.overrides import Override, apply
from apc.frame.parameter_names import ParameterRef, Range, unit_of
from apc.haptics.device_port import read_frequencies
from apc.haptics.frequency_response import transparency
from apc.haptics.peer_responses import gripped_names
from apc.mean_square.mean_square_stability import mean_square_stability
from apc.output.formatting import Plain
from apc.output.region_picture import plotted_points, stable_outlines
from apc.parameter_studies.critical_values import critical
from apc.parameter_studies.evaluator import reaches_count, reaches_time
from apc.parameter_studies.margins import margins
from apc.parameter_studies.root_locus import eigenvalues_at
from apc.parameter_studies.stability_criteria import MEAN_SQUARE
from apc.processes import model_of_bytes
from apc.regions.stable_region import region
from apc.tuning.specification import gripped_as_studied, read_tuning_spec
from apc.tuning.tuner import tune

# The relative error of a displayed boundary: below visibility.
PLOTTED = 1e-5
# Frequencies of the transparency analysis, and the lowest.
FREQUENCIES, LOWEST = 120, "0.1 Hz"
# Values of a slider at which eigenvalues are found; of a time or a count, where each takes an analysis.
ROOTS, FEW_ROOTS = 61, 16
EMPTY = np.zeros(0, dtype=np.complex128)


@dataclass(frozen=True, slots=True)
class Task:
    """A computation: a section, the changed parameters, and options of the section."""

    section: str
    overrides: tuple[Override, ...]
    request: Any = None


@dataclass(frozen=True, slots=True)
class SectionAnswer:
    """The result of a section, as plain data and arrays; None with the reason in `why`."""

    result: Plain | None
    why: str = ""


@lru_cache(maxsize=1)
def _open_model(model: bytes) -> tuple[Model, Prepared]:
    """Return the model of a page, and its numeric model, which all its analyses share."""
    system = model_of_bytes(model)
    return system, prepare(system)


def compute(model: bytes, task: Task) -> SectionAnswer:
    """Return the result of a section.

    Parameters
    ----------
    model
        The compiled model, from `processes.model_bytes`.
    task
        The task.
    """
    try:
        system, prepared = _open_model(model)
        changed = apply(system, task.overrides)
        return SectionAnswer(SECTIONS[task.section](changed, prepared, task.request))
    except ApcError as error:
        return SectionAnswer(
            None, "\n".join(mistake.reason for mistake in error.mistakes)
        )  # whose hints are for the terminal
    except Exception as error:  # the other sections go on
        return SectionAnswer(
            None, f"This is a bug of apc, not of your topology: {type(error).__name__}: {error}"
        )


def _verdict(system: Model, prepared: Prepared, _: None) -> Plain:
    analysis = analyze(system, prepared=prepared)
    values = np.array([mode.eigenvalue for mode in analysis.modes], dtype=np.complex128)
    return {
        "verdict": analysis.verdict + (", linearized" if analysis.linearized else ""),
        "stable": analysis.stable,
        "linear": not analysis.linearized,
        "at_once": not analysis.linearized or prepare_at_start(system, prepared) is not None,
        "radius": analysis.spectral_radius,
        "limits": _dominant_mode_text(analysis),
        "notes": analysis.limitations,
        "text": str(analysis),
        "real": values.real,
        "imag": values.imag,
        "names": [_named(mode) for mode in analysis.modes],
    }


def _named(mode: Mode) -> str:
    at = f" at {in_hertz(mode.frequency_hz)}" if mode.frequency_hz > 0 else ""
    return f"{mode.family}{at}"


def _dominant_mode_text(analysis: Analysis) -> str:
    """Return a sentence on the dominant mode: its growth or decay, and its largest participations."""
    if not analysis.modes:
        return "Nothing moves."
    dominant = analysis.modes[0]
    parts = sorted(dominant.participation, key=lambda pair: -pair[1])[:2]
    moves = " and ".join(name for name, _ in parts)
    changes = "grows" if dominant.magnitude > 1 else "dies out most slowly"
    times = f"by {dominant.magnitude:.6g} each {analysis.frame_s * 1e3:.6g} ms"
    return f"{_named(dominant)[0].upper()}{_named(dominant)[1:]} {changes}, {times}: mostly {moves}."


def _region(system: Model, prepared: Prepared, requested: tuple[Range, Range, str]) -> Plain:
    x, y, criterion = requested
    result = region(system, (x, y), tolerance=PLOTTED, criterion=criterion, prepared=prepared)
    return {
        "outlines": stable_outlines(result),
        "curves": [plotted_points(result, number) for number in range(len(result.curves))],
        "x": (x.free.label, x.unit, float(x.low), float(x.high)),
        "y": (y.free.label, y.unit, float(y.low), float(y.high)),
        "share": result.stable_area / float(result.rectangle.width.prod()),
        "notes": result.limitations,
        "stepped": result.stepped,
    }


def _roots(system: Model, prepared: Prepared, requested: tuple[ParameterRef, tuple[Fraction, ...]]) -> Plain:
    """Return the eigenvalues at values of a slider."""
    free, values = requested
    slow = reaches_time(system, free) or reaches_count(system, free)
    numbers = _thinned(values, FEW_ROOTS if slow else ROOTS)
    with finite_equations(system.name):
        indices, rows = eigenvalues_at(system, free, numbers, prepared=prepared)
    result = np.concatenate([EMPTY, *rows])
    texts = [text_of(number, unit_of(system, free.name)) for number in numbers]
    return {
        "real": result.real,
        "imag": result.imag,
        "name": [texts[index] for index, row in zip(indices, rows, strict=True) for _ in row],
        "slider": free.label,
        "from": texts[0],
        "to": texts[-1],
    }


def _thinned(values: Sequence[Fraction], most: int) -> list[Fraction]:
    """Return at most `count` of the values, including the first and the last."""
    indices = np.unique(np.linspace(0, len(values) - 1, min(most, len(values))).astype(int))
    return [values[index] for index in indices.tolist()]


def _margins(system: Model, prepared: Prepared, _: None) -> Plain:
    return {"text": str(margins(system, prepared=prepared, quick=True))}


def _tune(system: Model, _: Prepared, requested: tuple[tuple[str, ...], str]) -> Plain:
    """Return the best of the gains that the model's `studies: tune:` frees, or else of those asked for."""
    free, best = requested
    held, criterion = gripped_as_studied(system)
    tuning_spec = read_tuning_spec(held, free, maximize=best, criterion=criterion)
    return {"text": str(tune(held, tuning_spec))}


def _motion(system: Model, _: Prepared, struck: bool) -> Plain:
    return {"motion": motion_of(system, struck=struck)}


def _transparency(system: Model, prepared: Prepared, at: str) -> Plain:
    """Return the transparency at a device (by default the first), and the other devices."""
    frequencies = read_frequencies(system, None, LOWEST, None, FREQUENCIES)
    names = gripped_names(system, prepared)
    result = transparency(
        system, frequencies, at=at or next(iter(names), ""), alongside=(), prepared=prepared
    )
    return {
        "names": names,
        "at": result.at,
        "frequency": result.frequency_hz,
        "magnitude": np.abs(result.impedance),
        "phase": np.degrees(np.angle(result.impedance)),
        "notes": (*result.notes, *result.limitations),
    }


def _network(system: Model, prepared: Prepared, _: None) -> Plain:
    """Return the verdict over the network, and the loss and the jitter of each link at which it changes."""
    links = [link for link in system.links if link.channel is not None]
    if not links:
        name = system.links[0].name if system.links else "lan"
        message = "no link here loses packets or delays them by chance: there is nothing to look for"
        write = f"To look, write in the topology: links: {{{name}: {{…, loss: 1 %, jitter: 1 ms}}}}"
        raise ApcError(Diagnostic("E984", SourceLocation(system.name), f"{message}. {write}"))
    verdict = mean_square_stability(system, prepared)
    texts = ["Here packets are always on time." if verdict is None else str(verdict)]
    for link in links:
        assert link.channel is not None
        loss, jitter = link.channel.loss, link.channel.jitter
        names = [loss.p if loss else None, jitter]
        texts += [_critical(system, name) for name in names if name is not None]
    return {"text": "\n\n".join(texts)}


def _critical(system: Model, name: str) -> str:
    try:
        return str(critical(system, name, criterion=MEAN_SQUARE))
    except ApcError as error:
        return f"{name}: {error.mistakes[0].reason}"


def _numbers(system: Model, prepared: Prepared, requested: tuple[Range, Range, str] | None) -> Plain:
    """Return the downloaded data: the analysis and the region in the form of `--json`."""
    document = {"analyze": analyze(system, prepared=prepared).to_dict()}
    if requested is not None:
        x, y, criterion = requested
        document["region"] = region(system, (x, y), criterion=criterion, prepared=prepared).to_dict()
    return document


SECTIONS: dict[str, Callable[[Model, Prepared, Any], Plain]] = {
    "verdict": _verdict,
    "region": _region,
    "roots": _roots,
    "margins": _margins,
    "tune": _tune,
    "motion": _motion,
    "transparency": _transparency,
    "network": _network,
    "numbers": _numbers,
}
