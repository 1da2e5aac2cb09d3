"""The growth of second moments, with its slopes, at many values of coefficients of peers.

Takes: a `NumericModel` with independent packet losses or jitter, and the parameters that vary.
Gives: `moment_evaluator`, `MomentEvaluator`.
Guarantees: classes of peers, receiver memories and neutral motions are built once; at each value only frame
maps are computed. The slope is the derivative of the growth factor, by implicit differentiation.
Does not: bound errors (the inherited methods do); vary a channel's numbers, times or the point of
linearization: `moment_evaluator` returns a `RadiusEvaluator` then.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.analysis.one_sided_slopes import sides
from apc.compiler.errors import ApcError, SourceLocation
from apc.lifting.lift import FrameMap
from apc.lifting.numeric_model import NumericModel
from apc.mean_square.class_moments import (
    Classes,
    Moments,
    build_reception,
    classes_of,
    moments_of,
    stored_of,
)
from apc.mean_square.mean_dynamics import RouteMemory
from apc.mean_square.mean_square_stability import MOST_WORK, independent_channels
from apc.mean_square.second_moment_operator import (
    Operator,
    enclose_growth,
    growth_near_one,
    growth_with_slope,
)
from apc.network.nominal_criterion import channel_numbers
from apc.parameter_values.parameter_names import ParameterRef, value_now
from apc.studies.crossing import Verdict
from apc.studies.evaluator import generic, reaches_count, reaches_time
from apc.studies.frame_matrices import STEP, BatchEvaluator, batch_evaluator
from apc.studies.parameter_path import OPEN
from apc.studies.stability_criteria import (
    MEAN_SQUARE,
    NOWHERE,
    RadiusEvaluator,
    unbounded_verdict,
)

Floats = NDArray[np.float64]

# The relative error of an entry of a frame map in floats; an entry of 0 is exact. Only the test of
# neutral motions uses it: a smaller one refuses stiff couplings (tests/networks/test_moment_evaluator.py).
ROUNDED = 1e-12


@dataclass(frozen=True, eq=False)
class MomentEvaluator(RadiusEvaluator):
    """A `RadiusEvaluator` of the growth of second moments whose parameters change only frame maps.

    `lifts` evaluates the frame maps of all classes; `classes` and `memories` are valid at every value that
    is not 0, and at the `present` values (m,): with a coefficient of 0 there may be more neutral motions.
    """

    lifts: BatchEvaluator | None = None
    classes: Classes | None = None
    memories: Sequence[RouteMemory] = ()
    present: Floats | None = None

    def verdict(self, value: Sequence[float], *, bounded: bool = False) -> Verdict:
        """Return the verdict at a point (m,); undecided if the point has no value."""
        if bounded:
            return RadiusEvaluator.verdict(self, value, bounded=True)
        return self._verdict(value, lambda operator: enclose_growth(operator, bounded=False).radius)

    def quick_verdict(self, value: Sequence[float]) -> Verdict:
        """Return the verdict at a point (m,); its radius is an estimate on the same side of 1."""
        return self._verdict(value, growth_near_one)

    def _verdict(self, value: Sequence[float], growth: Callable[[Operator], float]) -> Verdict:
        """Return the verdict at a point (m,) by this function of the second-moment map."""
        point = np.array([value], dtype=np.float64)
        if not self._is_regular(point):
            return RadiusEvaluator.verdict(self, value)
        if not self._allowed(point).all():
            return OPEN
        try:
            (moments,) = self._moments(point)
        except ApcError as error:
            if error.mistakes[0].code not in NOWHERE:
                raise
            return OPEN
        radius = growth(moments.operator)
        return unbounded_verdict(radius)

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return the root of the growth (k, 1, 1) and its derivatives along directions (k, m)."""
        if not (self._is_regular(values) and self._allowed(values).all()):
            return RadiusEvaluator.slopes(self, values, along)
        pairs = [growth_with_slope(moments.operator) for moments in self._moments(values, along)]
        growth, slope = np.array(pairs).T[..., None, None]
        return ((np.sqrt(growth), slope / (2 * np.sqrt(growth))),)

    def _is_regular(self, values: Floats) -> bool:
        """Return whether the classes are valid at values (k, m)."""
        return bool(((values != 0) | (values == self.present)).all())

    def _moments(self, values: Floats, along: Floats | None = None) -> list[Moments]:
        """Return the second-moment operator at each value (k, m), over a cell along a given direction."""
        assert self.lifts is not None and self.classes is not None
        lifted = self.lifts.lifted(values if along is None else values + (STEP * 1j) * along)
        names = {peer_class.name: peer_class.index for peer_class in self.classes.common.peer_classes}

        def at_point(block: NDArray[np.complex128], k: int) -> Floats:
            """Return a matrix at one point with its error radius, and its derivative (2 or 3, n, n)."""
            item = block[min(k, len(block) - 1)]
            parts = [item.real, ROUNDED * np.abs(item.real)]
            return np.stack(parts if along is None else [*parts, item.imag / STEP])

        return [
            moments_of(
                self.classes,
                self.memories,
                {
                    name: FrameMap(*(at_point(block, k) for block in lifted[index].blocks))
                    for name, index in names.items()
                },
            )
            for k in range(len(values))
        ]


def moment_evaluator(
    numeric: NumericModel, parameter_refs: Sequence[ParameterRef], location: SourceLocation
) -> RadiusEvaluator:
    """Return the evaluator of the growth of second moments: a `MomentEvaluator` where parameters allow it.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    parameter_refs
        The parameters that vary.
    location
        The location of the request, for errors.
    """
    model, refs = numeric.model, tuple(parameter_refs)
    plain = RadiusEvaluator(numeric, refs, location)
    channels = channel_numbers(model)
    if (
        not independent_channels(model)
        or not all(subsystem.parameters_suffice for subsystem in numeric.subsystems)
        or any(ref.name in channels for ref in refs)
        or any(reaches_time(model, ref) or reaches_count(model, ref) for ref in refs)
    ):
        return plain
    present = np.array([value_now(model, ref) for ref in refs], dtype=np.float64)
    generic_point = numeric.at(generic(model, refs))
    if any(sides(point)[0].numeric is not point for point in (numeric, generic_point)):
        return plain
    reception = build_reception(generic_point)
    classes = classes_of(reception)
    at_present = classes_of(build_reception(numeric))
    memories = stored_of(generic_point.model, reception, classes.common)
    moments = moments_of(classes, memories)
    neutral = zip(classes.loops, at_present.loops, strict=False)
    if (
        moments.entries * moments.states**3 > MOST_WORK
        or len(classes.loops) != len(at_present.loops)
        or not all(np.array_equal(one.neutral, other.neutral) for one, other in neutral)
    ):
        return plain
    lifts = batch_evaluator(
        generic_point.model, refs, reception.peer_classes, reception.comm_graph, matrices=False
    )
    return MomentEvaluator(numeric, refs, location, MEAN_SQUARE, lifts, classes, memories, present)
