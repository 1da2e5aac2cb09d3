"""An aim against what a hand feels: the best of the one for every bound on the other (a Pareto front).

Takes: a `Model`, `TuningSpec`, and the quantity that their aim is weighed against.
Gives: `Design`, `ParetoFront`, `front`.
Guarantees: each design is that of `tune` with its bound as a demand, proved or not as there.
Does not: say that no designs lie beyond.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic
from apc.frame.instance import prepare
from apc.result import Result
from apc.tuning.demands import AGAINST, FELT, Objective, TransparencyMetric, TuningSpec
from apc.tuning.limits import ConstraintSet
from apc.tuning.tuner import Tuning, tune
from apc.vary.crossing import Progress

Floats = NDArray[np.float64]

POINTS = 20  # designs of a front
LEAST = 1 + 1e-3  # how far above the least that is felt the last bound is
SAME = 1e-3  # what is felt with the best gains is no more than the least there is, relatively


@dataclass(frozen=True, slots=True)
class Design:
    """Gains as they are typed, in SI; the aim with them, what is felt, and whether it is proved."""

    gains: tuple[tuple[str, float, str], ...]
    value: float
    felt: float
    proved: bool


@dataclass(frozen=True, slots=True)
class ParetoFront(Result):
    """Designs from the least that is felt to the best of the aim; `knee` is the place of the one between.

    The knee is farthest from the straight line between the ends, each axis counted from one end to the other.
    `criterion` is what stable means, one of `vary.growth`; `left_out` says what of the scene the designs do
    not look at, `notes` how far the search came.
    """

    shown_by = "tuning_output:front"

    topology: str
    aim: str
    unit: str
    larger: bool
    against: str
    against_unit: str
    designs: tuple[Design, ...]
    knee: int
    criterion: str
    left_out: tuple[str, ...]
    notes: tuple[str, ...]

    def plot(self, ax: Any = None) -> Any:
        """Draw the front; return the matplotlib Axes. Raises ApcError (E875) without matplotlib."""
        return self._shown("picture", ax)


def front(
    system: Model,
    demands: TuningSpec,
    against: TransparencyMetric,
    *,
    points: int = POINTS,
    seconds: float = float("inf"),
    progress: Progress | None = None,
) -> ParetoFront:
    """Return the best of an aim for each of several bounds on what a hand feels.

    Parameters
    ----------
    system, demands
        As for `tune`.
    against
        What is felt, its `most` of no meaning.
    points
        How many designs.
    seconds, progress
        As for `tune`; the time is that of all.

    Raises
    ------
    ApcError
        E996 what is felt is least where the aim is best.
    """
    until = time.monotonic() + seconds
    limits = ConstraintSet(system, prepare(system), replace(demands, felt=(against,)))
    every = limits.every()

    def felt(gains: Floats) -> float:
        """Return the largest that is felt in any scenario at gains (m,)."""
        points = ((scenario.setting, np.append(gains, scenario.point)[None]) for scenario in every)
        return max(float(limits.measured(*point, limits.demands)[0, 0, 0]) for point in points)

    best = tune(system, demands, seconds=seconds, progress=progress)
    least = Objective(against.label, len(demands.free), False, FELT[against.name][0], ((1.0, against),))
    other = tune(system, replace(demands, aim=least), seconds=until - time.monotonic(), progress=progress)
    low, high = other.best, felt(np.array([float(gain.value) for gain in best.gains]))
    if not (best.met and other.met):
        what = f"no gains were found in these ranges that meet all demands, whatever {against.label} is"
        raise ApcError(Diagnostic("E996", AGAINST, what))
    if not 0 < low < high * (1 - SAME):
        what = f"the best {demands.aim.label} is the best for {against.label}, too"
        what = f"{against.label} can be below 0: there are no bounds in equal ratios" if low <= 0 else what
        raise ApcError(Diagnostic("E996", AGAINST, what))
    designs, notes = [_design(best, high)], best.notes
    for place, bound in enumerate(np.geomspace(high, low * LEAST, points)[1:].tolist(), 1):
        left = until - time.monotonic()
        if left <= 0:
            notes = (*notes, f"the time was up after {place} of {points} bounds, the largest first")
            break
        asked = replace(demands, felt=(*demands.felt, replace(against, most=bound)))
        tuning = tune(system, asked, seconds=left, progress=progress)
        if tuning.met:
            designs.append(_design(tuning, felt(np.array([float(gain.value) for gain in tuning.gains]))))
    designs.sort(key=lambda design: design.felt)
    return ParetoFront(
        topology=system.name,
        aim=demands.aim.label,
        unit=best.unit,
        larger=demands.aim.larger,
        against=against.label,
        against_unit=FELT[against.name][0],
        designs=tuple(designs),
        knee=_knee(designs),
        criterion=demands.criterion,
        left_out=best.left_out,
        notes=notes,
    )


def _design(tuning: Tuning, felt: float) -> Design:
    gains = tuple((gain.parameter, float(gain.value), gain.unit) for gain in tuning.gains)
    return Design(gains, tuning.value, felt, tuning.proved)


def _knee(designs: list[Design]) -> int:
    """Return the place of the design farthest from the line between the ends."""
    points = np.array([(design.felt, design.value) for design in designs])
    size = np.ptp(points, axis=0)
    shares = (points - points[0]) / np.where(size == 0, 1.0, size) * np.sign(points[-1] - points[0])
    return int(np.argmax(shares[:, 1] - shares[:, 0]))
