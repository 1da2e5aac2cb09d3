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
from apc.haptics.device_port import read_frequencies
from apc.haptics.frequency_response import transparency
from apc.haptics.peer_responses import device_labels
from apc.lifting.numeric_model import NumericModel, numeric_model
from apc.linearization.evaluation_errors import finite_equations
from apc.mean_square.mean_square_stability import mean_square_stability
from apc.output.formatting import Plain
from apc.output.margins_output import margins_table
from apc.output.region_picture import plotted_points, stable_outlines
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import ParameterRef, Range, unit_of
from apc.regions.stable_region import region
from apc.spectrum.spectrum import Mode
from apc.studies.critical_values import critical
from apc.studies.evaluator_choice import EvaluatorKind, kind_for_parameter
from apc.studies.margins import margins
from apc.studies.root_locus import eigenvalues_at
from apc.studies.stability_criteria import MEAN_SQUARE
from apc.support.processes import model_of_bytes
from apc.tuning.specification import gripped_as_studied, read_tuning_spec
from apc.tuning.tuner import tune

# The relative error of a displayed boundary, which is not visible.
PLOTTED = 1e-5
# The number of frequencies of the transparency analysis, which resolves peaks, and the lowest frequency.
FREQUENCIES, LOWEST = 480, "0.1 Hz"
# The number of slider values for eigenvalues; fewer for a time or a count, where each requires an analysis.
ROOTS, FEW_ROOTS = 61, 16
EMPTY = np.zeros(0, dtype=np.complex128)


@dataclass(frozen=True, slots=True)
class Task:
    """A computation: a section, the changed parameters, and the options of the section."""

    section: str
    overrides: tuple[Override, ...]
    request: Any = None


@dataclass(frozen=True, slots=True)
class SectionAnswer:
    """The result of a section, as plain data and arrays; None if there is none, with the reason in `why`."""

    result: Plain | None
    why: str = ""


@lru_cache(maxsize=1)
def _open_model(model: bytes) -> NumericModel:
    """Return the model of a page, cached for all sections."""
    return numeric_model(model_of_bytes(model))


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
        numeric = _open_model(model)
        changed = numeric.at(apply(numeric.model, task.overrides))
        return SectionAnswer(SECTIONS[task.section](changed, task.request))
    except ApcError as error:
        # Without fixes, which are for the command line.
        return SectionAnswer(None, "\n".join(mistake.reason for mistake in error.mistakes))
    except Exception as error:  # the other sections are not affected
        return SectionAnswer(None, f"Internal error of apc: {type(error).__name__}: {error}")


def _verdict(numeric: NumericModel, criterion: str | None) -> Plain:
    """Return the verdict of the stability analysis by a criterion, and the eigenvalues."""
    analysis = analyze(numeric)
    network = mean_square_stability(numeric) if criterion == MEAN_SQUARE else None
    moments: Plain = {}
    if network is not None:
        moments = {
            "verdict": str(network.verdict),
            "stable": network.stable,
            "notes": (*network.notes, "The modes are those of the nominal network."),
        }
        if network.mean_square_radius is not None:
            moments |= {"measure": "second-moment growth", "radius": network.mean_square_radius}
    values = np.array([mode.eigenvalue for mode in analysis.modes], dtype=np.complex128)
    return {
        "verdict": analysis.verdict + (", linearized" if analysis.linearized else ""),
        "stable": analysis.stable,
        "linear": not analysis.linearized,
        "at_once": not analysis.linearized or prepare_at_start(numeric) is not None,
        "measure": "spectral radius",
        "radius": analysis.spectral_radius,
        "limits": _dominant_mode_text(analysis),
        "notes": analysis.limitations,
        "text": str(analysis),
        "real": values.real,
        "imag": values.imag,
        "names": [_mode_text(mode) for mode in analysis.modes],
        **moments,
    }


def _mode_text(mode: Mode) -> str:
    """Return the text of a mode: its family and frequency."""
    frequency_text = f" at {in_hertz(mode.frequency_hz)}" if mode.frequency_hz > 0 else ""
    return f"{mode.family}{frequency_text}"


def _dominant_mode_text(analysis: Analysis) -> str:
    """Return a sentence on the dominant mode: its growth or decay, and its largest participations."""
    if not analysis.modes:
        return "The topology has no modes."
    dominant = analysis.modes[0]
    parts = sorted(dominant.participation, key=lambda pair: -pair[1])[:2]
    moves = " and ".join(name for name, _ in parts)
    factor = f"{dominant.magnitude:.6g} per frame of {analysis.frame_s * 1e3:.6g} ms"
    return f"Dominant mode: {_mode_text(dominant)}, |eigenvalue| {factor}; largest participation: {moves}."


def _region(numeric: NumericModel, request: tuple[Range, Range, str]) -> Plain:
    """Return the stable region of two parameters: outlines, boundary curves and share of the area."""
    x, y, criterion = request
    result = region(numeric, (x, y), tolerance=PLOTTED, criterion=criterion)
    return {
        "outlines": stable_outlines(result),
        "curves": [plotted_points(result, number) for number in range(len(result.curves))],
        "x": (x.free.label, x.unit, float(x.low), float(x.high)),
        "y": (y.free.label, y.unit, float(y.low), float(y.high)),
        "share": result.stable_area / float(result.rectangle.width.prod()),
        "notes": result.limitations,
        "stepped": result.stepped,
    }


def _roots(numeric: NumericModel, request: tuple[ParameterRef, tuple[Fraction, ...]]) -> Plain:
    """Return the root locus: the eigenvalues at values of a slider."""
    model = numeric.model
    free, values = request
    slow = kind_for_parameter(model, free) is not EvaluatorKind.MATRICES
    numbers = _thinned(values, FEW_ROOTS if slow else ROOTS)
    with finite_equations(model):
        indices, rows = eigenvalues_at(numeric, free, numbers)
    result = np.concatenate([EMPTY, *rows])
    texts = [text_of(number, unit_of(model, free.name)) for number in numbers]
    return {
        "real": result.real,
        "imag": result.imag,
        "name": [texts[index] for index, row in zip(indices, rows, strict=True) for _ in row],
        "slider": free.label,
        "from": texts[0],
        "to": texts[-1],
    }


def _thinned(values: Sequence[Fraction], most: int) -> list[Fraction]:
    """Return at most `most` of the values, equally spaced, with the first and the last."""
    indices = np.unique(np.linspace(0, len(values) - 1, min(most, len(values))).astype(int))
    return [values[index] for index in indices.tolist()]


def _margins(numeric: NumericModel, _: None) -> Plain:
    """Return the text of the stability margins."""
    lines = list(margins_table(margins(numeric, quick=True)))
    if any(link.channel for link in numeric.model.links):
        lines.append("  nominal network: packet loss and jitter are excluded")
    return {"text": "\n".join(lines)}


def _tune(numeric: NumericModel, request: tuple[tuple[str, ...], str]) -> Plain:
    """Return the text of the optimal gains.

    The gains and the objective are those of the model's `studies: tune:`, or else those of the request.
    """
    free, objective = request
    with_hands, criterion = gripped_as_studied(numeric.model)
    tuning_spec = read_tuning_spec(with_hands, free, maximize=objective, criterion=criterion)
    return {"text": str(tune(with_hands, tuning_spec))}


def _motion(numeric: NumericModel, struck: bool) -> Plain:
    """Return the simulated motion, with or without an impulse at the start."""
    return {"motion": motion_of(numeric.model, struck=struck)}


def _transparency(numeric: NumericModel, at: str) -> Plain:
    """Return the impedance at a device (by default the first), and the names of all devices."""
    frequencies = read_frequencies(numeric.model, None, LOWEST, None, FREQUENCIES)
    names = device_labels(numeric)
    result = transparency(numeric, frequencies, at=at or next(iter(names), ""), alongside=())
    return {
        "names": names,
        "at": result.at,
        "frequency": result.frequency_hz,
        "magnitude": np.abs(result.impedance),
        "phase": np.degrees(np.angle(result.impedance)),
        "notes": (*result.notes, *result.limitations),
    }


def _network(numeric: NumericModel, _: None) -> Plain:
    """Return the text of the verdict over the lossy network, and of the critical loss and jitter of
    each link.
    """
    model = numeric.model
    links = [link for link in model.links if link.channel is not None]
    if not links:
        name = model.links[0].name if model.links else "lan"
        message = "no link here loses packets or has random delays"
        write = f"Write in the topology: links: {{{name}: {{…, loss: 1 %, jitter: 1 ms}}}}"
        raise ApcError(Diagnostic("E984", SourceLocation(model.name), f"{message}. {write}"))
    verdict = mean_square_stability(numeric)
    texts = ["Every packet is on time." if verdict is None else str(verdict)]
    for link in links:
        names = [
            name
            for channel in link.channels
            for name in (channel.loss and channel.loss.p, channel.jitter)
            if name
        ]
        texts += [_critical(model, name) for name in dict.fromkeys(names)]
    return {"text": "\n\n".join(texts)}


def _critical(model: Model, name: str) -> str:
    """Return the text of the critical values of a parameter, or of the reason if there are none."""
    try:
        return str(critical(model, name, criterion=MEAN_SQUARE))
    except ApcError as error:
        return f"{name}: {error.mistakes[0].reason}"


def _numbers(numeric: NumericModel, request: tuple[Range, Range, str] | None) -> Plain:
    """Return the data for download: the analysis and the region, in the form of `--json`."""
    document = {"analyze": analyze(numeric).to_dict()}
    if request is not None:
        x, y, criterion = request
        document["region"] = region(numeric, (x, y), criterion=criterion).to_dict()
    return document


SECTIONS: dict[str, Callable[[NumericModel, Any], Plain]] = {
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
