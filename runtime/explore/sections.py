"""What each section of the page shows, computed where the page doesn't wait for it.

Takes: a compiled model as bytes, and a `Task`: a section, the numbers that were moved, what it is asked.
Gives: `Task`, `SectionAnswer`, `compute`; `SECTIONS`.
Guarantees: every number is one that the function of the public API gives; a section that a scene has nothing
for says so in words; what is at fault is told as `apc` tells it.
Does not: know the browser, or keep an answer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Any

import numpy as np

from apc.analysis.analysis import Analysis, analyze, prepare_at_start
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.words import in_hertz
from apc.eigen.spectrum import Mode
from apc.explore.motion import motion_of
from apc.explore.sliders import text_of
from apc.frame.finite_equations import finite_equations
from apc.frame.instance import Prepared, prepare
from apc.frame.names import ParameterRef, Range, unit_of
from apc.frame.overrides import Override, apply
from apc.hands.answers import held_names
from apc.hands.asked import read_frequencies
from apc.hands.frequency_response import feel
from apc.moments.network_verdict import judge_network
from apc.present.forms import Plain
from apc.present.region_picture import drawn_points, stable_outlines
from apc.processes import model_of_bytes
from apc.regions.stable_region import region
from apc.tuning.demands import held_as_studied, read_demands
from apc.tuning.tuner import tune
from apc.vary.critical_values import critical
from apc.vary.evaluator import reaches_count, reaches_time
from apc.vary.growth import MEAN_SQUARE
from apc.vary.locus import eigenvalues_at
from apc.vary.margins import margins

# How far a boundary that is drawn may be off, relative to a coordinate: nobody sees less.
DRAWN = 1e-5
# Frequencies at which it is told what a hand feels, and the lowest.
FREQUENCIES, LOWEST = 120, "0.1 Hz"
# Values of a slider at which eigenvalues are found; of a time or a count, where each takes an analysis.
ROOTS, FEW_ROOTS = 61, 16
EMPTY = np.zeros(0, dtype=np.complex128)


@dataclass(frozen=True, slots=True)
class Task:
    """What is to be computed: a section, the numbers that were moved, and what else the section asks."""

    section: str
    overrides: tuple[Override, ...]
    asked: Any = None


@dataclass(frozen=True, slots=True)
class SectionAnswer:
    """What a section has to show, as plain data and arrays; None with the reason in `why`."""

    found: Plain | None
    why: str = ""


@lru_cache(maxsize=1)
def _opened(model: bytes) -> tuple[Model, Prepared]:
    """Return the scene of a page, and what all its analyses share."""
    system = model_of_bytes(model)
    return system, prepare(system)


def compute(model: bytes, task: Task) -> SectionAnswer:
    """Return what a section shows.

    Parameters
    ----------
    model
        The compiled model, from `processes.model_bytes`.
    task
        What is asked.
    """
    try:
        system, prepared = _opened(model)
        changed = apply(system, task.overrides)
        return SectionAnswer(SECTIONS[task.section](changed, prepared, task.asked))
    except ApcError as error:
        return SectionAnswer(
            None, "\n".join(mistake.reason for mistake in error.mistakes)
        )  # whose hints are for the terminal
    except Exception as error:  # the other sections go on
        return SectionAnswer(
            None, f"This is a bug of apc, not of your scene: {type(error).__name__}: {error}"
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
        "limits": _limits(analysis),
        "notes": analysis.left_out,
        "text": str(analysis),
        "real": values.real,
        "imag": values.imag,
        "names": [_named(mode) for mode in analysis.modes],
    }


def _named(mode: Mode) -> str:
    at = f" at {in_hertz(mode.frequency_hz)}" if mode.frequency_hz > 0 else ""
    return f"{mode.shape}{at}"


def _limits(analysis: Analysis) -> str:
    """Return in a sentence which motion decides the verdict."""
    if not analysis.modes:
        return "Nothing moves."
    leading = analysis.modes[0]
    parts = sorted(leading.participation, key=lambda pair: -pair[1])[:2]
    moves = " and ".join(name for name, _ in parts)
    changes = "grows" if leading.magnitude > 1 else "dies out most slowly"
    times = f"by {leading.magnitude:.6g} each {analysis.frame_s * 1e3:.6g} ms"
    return f"{_named(leading)[0].upper()}{_named(leading)[1:]} {changes}, {times}: mostly {moves}."


def _region(system: Model, prepared: Prepared, asked: tuple[Range, Range, str]) -> Plain:
    x, y, criterion = asked
    result = region(system, (x, y), tolerance=DRAWN, criterion=criterion, prepared=prepared)
    return {
        "outlines": stable_outlines(result),
        "curves": [drawn_points(result, number) for number in range(len(result.curves))],
        "x": (x.free.label, x.unit, float(x.low), float(x.high)),
        "y": (y.free.label, y.unit, float(y.low), float(y.high)),
        "share": result.stable_area / float(result.rectangle.width.prod()),
        "notes": result.left_out,
        "stepped": result.stepped,
    }


def _roots(system: Model, prepared: Prepared, asked: tuple[ParameterRef, tuple[Fraction, ...]]) -> Plain:
    """Return the eigenvalues at values of a slider."""
    free, values = asked
    slow = reaches_time(system, free) or reaches_count(system, free)
    numbers = _thinned(values, FEW_ROOTS if slow else ROOTS)
    with finite_equations(system.name):
        places, rows = eigenvalues_at(system, free, numbers, prepared=prepared)
    result = np.concatenate([EMPTY, *rows])
    texts = [text_of(number, unit_of(system, free.name)) for number in numbers]
    return {
        "real": result.real,
        "imag": result.imag,
        "name": [texts[place] for place, row in zip(places, rows, strict=True) for _ in row],
        "slider": free.label,
        "from": texts[0],
        "to": texts[-1],
    }


def _thinned(values: Sequence[Fraction], most: int) -> list[Fraction]:
    """Return so many of the values at most, the first and the last among them."""
    places = np.unique(np.linspace(0, len(values) - 1, min(most, len(values))).astype(int))
    return [values[place] for place in places.tolist()]


def _margins(system: Model, prepared: Prepared, _: None) -> Plain:
    return {"text": str(margins(system, prepared=prepared, quick=True))}


def _tune(system: Model, _: Prepared, asked: tuple[tuple[str, ...], str]) -> Plain:
    """Return the best of the gains that the scene's `studies: tune:` frees, or else of those asked for."""
    free, best = asked
    held, criterion = held_as_studied(system)
    demands = read_demands(held, free, maximize=best, criterion=criterion)
    return {"text": str(tune(held, demands))}


def _motion(system: Model, _: Prepared, struck: bool) -> Plain:
    return {"motion": motion_of(system, struck=struck)}


def _feel(system: Model, prepared: Prepared, at: str) -> Plain:
    """Return what is felt at a device, the first there is if it isn't said, and what else may be held."""
    frequencies = read_frequencies(system, None, LOWEST, None, FREQUENCIES)
    names = held_names(system, prepared)
    result = feel(system, frequencies, at=at or next(iter(names), ""), beside=(), prepared=prepared)
    return {
        "names": names,
        "at": result.at,
        "frequency": result.frequency_hz,
        "magnitude": np.abs(result.impedance),
        "phase": np.degrees(np.angle(result.impedance)),
        "notes": (*result.notes, *result.left_out),
    }


def _network(system: Model, prepared: Prepared, _: None) -> Plain:
    """Return the verdict over the network, and the loss and the jitter of each link at which it changes."""
    links = [link for link in system.links if link.channel is not None]
    if not links:
        name = system.links[0].name if system.links else "lan"
        what = "no link here loses packets or delays them by chance: there is nothing to look for"
        write = f"To look, write in the topology: links: {{{name}: {{…, loss: 1 %, jitter: 1 ms}}}}"
        raise ApcError(Diagnostic("E984", SourceLocation(system.name), f"{what}. {write}"))
    verdict = judge_network(system, prepared)
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


def _numbers(system: Model, prepared: Prepared, asked: tuple[Range, Range, str] | None) -> Plain:
    """Return what is downloaded: the analysis and the region as `--json` prints them."""
    document = {"analyze": analyze(system, prepared=prepared).to_dict()}
    if asked is not None:
        x, y, criterion = asked
        document["region"] = region(system, (x, y), criterion=criterion, prepared=prepared).to_dict()
    return document


SECTIONS: dict[str, Callable[[Model, Prepared, Any], Plain]] = {
    "verdict": _verdict,
    "region": _region,
    "roots": _roots,
    "margins": _margins,
    "tune": _tune,
    "motion": _motion,
    "feel": _feel,
    "network": _network,
    "numbers": _numbers,
}
