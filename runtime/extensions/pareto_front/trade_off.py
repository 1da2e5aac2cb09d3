"""The Pareto front of an objective and a transparency metric: the optimum for each bound on the metric.

Takes: a `Model`, `TuningSpec`, and the second quantity of the trade-off.
Gives: `Design`, `ParetoFront`, `pareto_front`.
Guarantees: each design is the result of `tune` with its bound as a demand, proved or not.
Does not: prove that no better designs exist.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic
from apc.lifting.numeric_model import numeric_model
from apc.result import Result
from apc.studies.crossing import Progress
from apc.tuning.constraints import ConstraintSet
from apc.tuning.specification import TRADEOFF, TRANSPARENCY, Objective, TransparencyMetric, TuningSpec
from apc.tuning.tuner import Tuning, tune

Floats = NDArray[np.float64]

POINTS = 20  # designs of a front
LEAST = 1 + 1e-3  # factor from the smallest transparency metric to the last bound
SAME = 1e-3  # relative tolerance for equality of the metric at the optimum and its minimum


@dataclass(frozen=True, slots=True)
class Design:
    """One design of the front: decimal gains in SI, objective, transparency metric, and whether it is
    proved.
    """

    gains: tuple[tuple[str, float, str], ...]
    value: float
    transparency: float
    proved: bool


@dataclass(frozen=True, slots=True)
class ParetoFront(Result):
    """The designs from the smallest metric to the best objective; `knee` is the index of the knee.

    The knee has the largest distance from the straight line between the ends, each axis scaled from one end
    to the other. `criterion` is the stability criterion, one of `studies.stability_criteria`;
    `limitations` are the limitations of the designs, `notes` describe the progress of the search.
    """

    shown_by = "apc.extensions.pareto_front.pareto_front_output:pareto_front"

    topology: str
    objective: str
    unit: str
    maximize: bool
    tradeoff: str
    tradeoff_unit: str
    designs: tuple[Design, ...]
    knee: int
    criterion: str
    limitations: tuple[str, ...]
    notes: tuple[str, ...]

    def plot(self, ax: Any = None) -> Any:
        """Draw the front; return the matplotlib Axes. Raises ApcError (E875) without matplotlib."""
        return self._shown("picture", ax)


def pareto_front(
    model: Model,
    spec: TuningSpec,
    tradeoff: TransparencyMetric,
    *,
    points: int = POINTS,
    seconds: float = float("inf"),
    progress: Progress | None = None,
) -> ParetoFront:
    """Return the optimal designs for several bounds on a transparency metric.

    Parameters
    ----------
    model, spec
        As for `tune`.
    tradeoff
        The transparency metric; its `most` is ignored.
    points
        The number of designs.
    seconds, progress
        As for `tune`; the time limit is for all designs together.

    Raises
    ------
    ApcError
        E996 the metric is smallest at the best objective.
    """
    until = time.monotonic() + seconds
    constraints = ConstraintSet(numeric_model(model), replace(spec, transparency_metrics=(tradeoff,)))
    scenarios = constraints.every()

    def transparency(gains: Floats) -> float:
        """Return the largest value of the metric over all scenarios at gains (m,)."""
        points = ((scenario.setting, np.append(gains, scenario.point)[None]) for scenario in scenarios)
        return max(float(constraints.measured(*point, constraints.spec)[0, 0, 0]) for point in points)

    best = tune(model, spec, seconds=seconds, progress=progress)
    metric_objective = Objective(
        tradeoff.label, len(spec.free), False, TRANSPARENCY[tradeoff.name][0], ((1.0, tradeoff),)
    )
    lowest_metric = tune(
        model, replace(spec, objective=metric_objective), seconds=until - time.monotonic(), progress=progress
    )
    least_metric, largest_metric = (
        lowest_metric.optimum,
        transparency(np.array([float(gain.value) for gain in best.gains])),
    )
    if not (best.feasible and lowest_metric.feasible):
        message = f"no gains in these ranges meet all constraints at any {tradeoff.label}"
        raise ApcError(Diagnostic("E996", TRADEOFF, message))
    if not 0 < least_metric < largest_metric * (1 - SAME):
        message = f"{spec.objective.label} and {tradeoff.label} have the same optimum"
        message = (
            f"{tradeoff.label} can be negative, so bounds in equal ratios are undefined"
            if least_metric <= 0
            else message
        )
        raise ApcError(Diagnostic("E996", TRADEOFF, message))
    designs, notes = [_design(best, largest_metric)], best.notes
    for index, bound in enumerate(np.geomspace(largest_metric, least_metric * LEAST, points)[1:].tolist(), 1):
        remaining = until - time.monotonic()
        if remaining <= 0:
            notes = (
                *notes,
                f"the time limit was reached after {index} of {points} bounds, the largest first",
            )
            break
        bounded_spec = replace(
            spec, transparency_metrics=(*spec.transparency_metrics, replace(tradeoff, most=bound))
        )
        tuning = tune(model, bounded_spec, seconds=remaining, progress=progress)
        if tuning.feasible:
            designs.append(
                _design(tuning, transparency(np.array([float(gain.value) for gain in tuning.gains])))
            )
    designs.sort(key=lambda design: design.transparency)
    return ParetoFront(
        topology=model.name,
        objective=spec.objective.label,
        unit=best.unit,
        maximize=spec.objective.maximize,
        tradeoff=tradeoff.label,
        tradeoff_unit=TRANSPARENCY[tradeoff.name][0],
        designs=tuple(designs),
        knee=_knee(designs),
        criterion=spec.criterion,
        limitations=best.limitations,
        notes=notes,
    )


def _design(tuning: Tuning, transparency: float) -> Design:
    """Return a tuning result as a design of the front."""
    gains = tuple((gain.parameter, float(gain.value), gain.unit) for gain in tuning.gains)
    return Design(gains, tuning.value, transparency, tuning.proved)


def _knee(designs: list[Design]) -> int:
    """Return the index of the design farthest from the line between the ends."""
    points = np.array([(design.transparency, design.value) for design in designs])
    size = np.ptp(points, axis=0)
    scaled = (points - points[0]) / np.where(size == 0, 1.0, size) * np.sign(points[-1] - points[0])
    return int(np.argmax(scaled[:, 1] - scaled[:, 0]))
