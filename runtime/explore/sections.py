"""What each section of the page shows, computed where the page doesn't wait for it.

Takes: a compiled model as bytes, and a `Task`: a section, the numbers that were moved, what it is asked.
Gives: `Task`, `Told`, `compute`; `SECTIONS`.
Guarantees: every number is one that the function of the public API gives; a section that a scene has nothing
for says so in words; what is at fault is told as `apc` tells it.
Does not: know the browser, or keep an answer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, Prepared, analyze, prepare
from apc.analysis.needs import needs
from apc.compiler.compiled import Column, CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.frozen import dataclass
from apc.compiler.words import in_hertz, with_unit
from apc.eigen.spectrum import Mode
from apc.frame.names import Free, Range, named_times
from apc.frame.overrides import Override, apply
from apc.network.nominal import left_out
from apc.processes import model_of_bytes
from apc.regions.region import region
from apc.threads import single_threaded
from apc.vary.evaluator import reaches_count, reaches_time

Floats = NDArray[np.float64]

# Frequencies at which it is told what a hand feels, and the lowest, in Hz.
FREQUENCIES, LOWEST = 120, 0.1
# Values at which the roots of a slider are found: more lie on each other.
ROOTS = 61
# Values of what has no matrices in rows: each is an analysis.
FEW_ROOTS = 16
# How fast the struck device starts, in m/s, and how long that is watched, in s, where the scene doesn't say.
STRUCK, WATCHED = 0.1, Fraction(1)
# Rows of a motion that are shown, and peers.
ROWS, PEERS = 400, 8


@dataclass(frozen=True, slots=True)
class Task:
    """What is to be computed: a section, the numbers that were moved, and what else the section asks."""

    section: str
    overrides: tuple[Override, ...]
    asked: Any = None


@dataclass(frozen=True, slots=True)
class Told:
    """What a section has to show, as plain data and arrays; None with the reason in `why`."""

    found: Mapping[str, Any] | None
    why: str = ""


@lru_cache(maxsize=1)
def _opened(model: bytes) -> tuple[CompiledSystem, Prepared]:
    """Return the scene of a page, and what all its analyses share."""
    system = model_of_bytes(model)
    return system, prepare(system)


def compute(model: bytes, task: Task) -> Told:
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
        return Told(SECTIONS[task.section](changed, prepared, task.asked))
    except ApcError as error:
        return Told(None, "\n".join(one.sentence for one in error.mistakes))
    except NothingToShowError as nothing:
        return Told(None, str(nothing))


class NothingToShowError(Exception):
    """A scene has nothing for a section; the text says why."""


def _verdict(system: CompiledSystem, prepared: Prepared, _: None) -> dict[str, Any]:
    found = analyze(system, prepared=prepared)
    values = np.array([mode.eigenvalue for mode in found.modes], dtype=np.complex128)
    return {
        "verdict": found.verdict + (", linearized" if found.linearized else ""),
        "stable": found.stable,
        "radius": found.spectral_radius,
        "limits": _limits(found),
        "text": str(found),
        "real": values.real,
        "imag": values.imag,
        "names": [_named(mode) for mode in found.modes],
    }


def _named(mode: Mode) -> str:
    at = "" if np.isnan(mode.frequency_hz) else f" at {in_hertz(mode.frequency_hz)}"
    return f"{mode.shape}{at}"


def _limits(found: Analysis) -> str:
    """Return in a sentence which motion decides the verdict."""
    if not found.modes:
        return "Nothing moves."
    leading = found.modes[0]
    parts = sorted(leading.participation, key=lambda one: -one[1])[:2]
    moves = " and ".join(name for name, _ in parts)
    changes = "grows" if leading.magnitude > 1 else "dies out most slowly"
    times = f"by {leading.magnitude:.6g} each {found.frame_s * 1e3:.6g} ms"
    return f"{_named(leading)[0].upper()}{_named(leading)[1:]} {changes}, {times}: mostly {moves}."


def _region(system: CompiledSystem, prepared: Prepared, asked: tuple[Range, Range, str]) -> dict[str, Any]:
    from apc.present.region_picture import stable_outlines

    x, y, criterion = asked
    found = region(system, (x, y), criterion=criterion, prepared=prepared)
    whole = float(found.rectangle.width.prod())
    return {
        "outlines": stable_outlines(found),
        "curves": [curve.points for curve in found.curves],
        "x": (x.free.label, x.unit, float(x.low), float(x.high)),
        "y": (y.free.label, y.unit, float(y.low), float(y.high)),
        "share": found.stable_area / whole,
        "notes": found.left_out,
        "stepped": found.stepped,
    }


SECTIONS: dict[str, Callable[[CompiledSystem, Prepared, Any], dict[str, Any]]] = {
    "verdict": _verdict,
    "region": _region,
}
