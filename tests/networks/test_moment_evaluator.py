"""The growth of second moments at many values, and its slopes, against analyses one by one."""

from __future__ import annotations

import numpy as np
import pytest

import apc
from apc.compiler.errors import SourceLocation
from apc.lifting.numeric_model import numeric_model
from apc.parameter_values.parameter_names import find
from apc.studies.evaluator_choice import radius_evaluator
from apc.studies.moment_evaluator import MomentEvaluator
from apc.studies.stability_criteria import RadiusEvaluator
from tests.topologies import TOPOLOGIES

HERE = SourceLocation("test")
PARAMETERS = ("contact.stiffness", "coordination.stiffness")


def evaluators(model: apc.Model, *names: str) -> tuple[RadiusEvaluator, RadiusEvaluator]:
    """Return the evaluator by full analyses, and the one of a model's parameters."""
    refs = tuple(find(model, name) for name in names)
    numeric = numeric_model(model)
    return RadiusEvaluator(numeric, refs, HERE), radius_evaluator(numeric, refs, HERE)


@pytest.fixture(scope="module")
def lossy() -> apc.Model:
    return apc.compile(TOPOLOGIES / "lossy-average.yaml")


def test_values_and_slopes_are_those_of_analyses(lossy: apc.Model) -> None:
    """Also close to the pole, where noise adds 1e-8 to the growth of the means.

    The reference is a central difference extrapolated from steps of 1e-3 and 5e-4 (Richardson): its
    truncation is of the fourth order, 1e-11, its rounding 1e-13/1e-3.
    """
    analyses, evaluator = evaluators(lossy, *PARAMETERS)
    assert isinstance(evaluator, MomentEvaluator)
    rng = np.random.default_rng(0)
    values = 10 + 3000 * rng.random((8, 2))
    along = values * rng.standard_normal((8, 2))
    ((roots, slopes),) = evaluator.slopes(values, along)

    def root(point: np.ndarray) -> float:
        return float(np.sqrt(analyses.verdict(point.tolist()).radius))

    for value, direction, found, slope in zip(values, along, roots.ravel(), slopes.ravel(), strict=True):
        assert found == pytest.approx(root(value), rel=1e-13)
        assert evaluator.verdict(value.tolist()).radius == pytest.approx(found**2, rel=1e-13)
        coarse, fine = (
            (root(value + step * direction) - root(value - step * direction)) / (2 * step)
            for step in (1e-3, 5e-4)
        )
        assert slope == pytest.approx((4 * fine - coarse) / 3, rel=1e-6)


def test_where_noise_adds_nothing_the_slope_is_that_of_the_means(lossy: apc.Model) -> None:
    model = apc.set_parameters(lossy, {"links.lan.loss": 0})
    analyses, evaluator = evaluators(model, PARAMETERS[0])
    value = np.array([[800.0]])
    ((_, slope),) = evaluator.slopes(value, value)
    ends = [np.sqrt(analyses.verdict([800 * (1 + step)]).radius) for step in (-1e-4, 1e-4)]
    assert slope.item() == pytest.approx((ends[1] - ends[0]) / 2e-4, rel=1e-5)


@pytest.mark.parametrize("name", ["links.lan.loss", "links.lan.delay"])
def test_a_number_of_a_channel_is_evaluated_by_analyses(lossy: apc.Model, name: str) -> None:
    _, evaluator = evaluators(lossy, name)
    assert not isinstance(evaluator, MomentEvaluator)


def test_at_zero_further_neutral_motions_are_left_out(lossy: apc.Model) -> None:
    """Without a coordinating stiffness each copy translates alone; the other motions decay."""
    analyses, evaluator = evaluators(lossy, PARAMETERS[1])
    assert evaluator.verdict([0.0]).radius == analyses.verdict([0.0]).radius < 1


def test_a_stiff_contact_is_evaluated_as_by_analyses(lossy: apc.Model) -> None:
    """Its frame map has rounding errors far above those of one product of floats."""
    analyses, evaluator = evaluators(lossy, *PARAMETERS)
    assert isinstance(evaluator, MomentEvaluator)
    for stiffness in (2500.0, 12500 / 3, 5000.0):
        value = (stiffness, 125.0)
        assert evaluator.verdict(value).radius == pytest.approx(analyses.verdict(value).radius, rel=1e-12)


@pytest.mark.parametrize("loss", [0.0, 0.05, 0.6])
def test_the_estimated_growth_is_on_the_same_side_of_one(lossy: apc.Model, loss: float) -> None:
    """Stable and unstable points; no estimate is twice as far from 1 as the growth."""
    model = apc.set_parameters(lossy, {"links.lan.loss": loss})
    _, evaluator = evaluators(model, *PARAMETERS)
    points = 10 + np.array([4500.0, 3000.0]) * np.random.default_rng(1).random((40, 2))
    pairs = [(evaluator.verdict(point), evaluator.quick_verdict(point)) for point in points.tolist()]
    assert {found.stable for found, _ in pairs} == {False, True}
    for found, estimate in pairs:
        assert estimate.stable is found.stable
        assert abs(estimate.radius - found.radius) <= abs(found.radius - 1)
