"""Claims about `apc.vary.sensitivity`."""

from __future__ import annotations

from fractions import Fraction
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from apc.analysis.analysis import analyze
from apc.eigen.balls import precision
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.vary.batch import BatchEvaluator
from apc.vary.evaluator import evaluator
from apc.vary.sensitivity import _Cluster, _defective, _differentiate, sensitivities
from apc.vary.slopes import moved_systems
from tests.bench.sensitivity_truth import check_sensitivities
from tests.topologies import AVERAGE, MESH, SCENES, compiled, replaced

FINGER = (SCENES / "finger.yaml").read_text(encoding="utf-8")


def test_derivatives_are_central_differences_in_50_digits() -> None:
    """Eigenvalues in balls at p ± h, h = 2^−20 p: what a difference cuts off is below 1e-12."""
    import flint

    from apc.eigen.balls import frame_balls, reduced_balls

    system = compiled(replaced(AVERAGE, ("contact:      {", "contact:      {damping: 1 N*s/m, ")))
    found = sensitivities(system)
    ((value, _),) = found.active
    for row in found.rows:
        if not row.value:
            continue
        family = evaluator(system, [Free(row.parameter)])
        assert isinstance(family, BatchEvaluator)
        sizes = []
        ends = row.value * (1 - 2.0**-20), row.value * (1 + 2.0**-20)
        with precision(300):
            for end in ends:
                size = None
                for closed, wiring in zip(family.exact_at([end]), family.wirings, strict=True):
                    held = wiring.relative.held
                    reduced = reduced_balls(frame_balls(closed), wiring.rigid.exact, held)
                    n = len(reduced)
                    square = flint.arb_mat(n, n, [flint.arb(e) for e in reduced.ravel()])
                    roots = flint.acb_mat(square.mid()).eig(algorithm="approx")
                    near = min(roots, key=lambda r: abs(complex(r.mid()) - value))
                    if abs(complex(near.mid()) - value) < 1e-6:
                        size = abs(near)
                assert size is not None
                sizes.append(size)
            rate = float(((sizes[1] - sizes[0]) / (ends[1] - ends[0])).mid())
        assert row.derivative == pytest.approx(rate, rel=1e-9, abs=0)
        assert abs(row.derivative - rate) <= row.error + 1e-10 * abs(rate)
        assert row.relative == pytest.approx(rate * row.value, rel=1e-9)


def test_where_the_groups_differ_each_has_a_derivative_of_its_own() -> None:
    one = "  one: {count: 1, set: {device.mass: 0.14 kg}}\n"
    text = replaced(AVERAGE, ("  user: {count: 3}", one + "  two: {count: 2}"))
    own = replaced(AVERAGE, ("  user: {count: 3}", one + "  two: {count: 2, set: {device.mass: 0.1 kg}}"))
    found = {row.parameter: row.derivative for row in sensitivities(compiled(text)).rows}
    other = {row.parameter: row.derivative for row in sensitivities(compiled(own)).rows}
    assert "device.mass" not in found.keys() | other.keys()
    assert found["two.device.mass"] == pytest.approx(other["two.device.mass"], rel=1e-9)
    assert found["one.device.mass"] == pytest.approx(other["one.device.mass"], rel=1e-9)


def test_equal_groups_have_an_active_set_and_no_single_gradient() -> None:
    """The difference modes of three equal users are two; changing one user alone moves them apart."""
    text = replaced(
        AVERAGE,
        (
            "  user: {count: 3}",
            "  one: {count: 1, set: {contact.stiffness: 1000 N/m}}\n  two: {count: 2}",
        ),
    )
    system = compiled(text)
    found = sensitivities(system)
    assert len(found.active) == 2
    assert "share the radius" in found.note
    rates = sorted(row.derivative for row in found.rows if row.parameter == "one.contact.stiffness")
    step = 1e-3
    radius = [
        analyze(
            apply(system, [Override(Free("contact.stiffness", "one"), Fraction(1000.0 + side))])
        ).spectral_radius
        for side in (-step, 0.0, step)
    ]
    assert (radius[2] - radius[1]) / step == pytest.approx(max(rates), rel=1e-4, abs=1e-9)
    assert (radius[1] - radius[0]) / step == pytest.approx(min(rates), rel=1e-4, abs=1e-9)


def test_the_table_names_what_moves_most_in_80_columns() -> None:
    found = sensitivities(compiled(AVERAGE))
    text = str(found)
    assert "device.damping" in text.splitlines()[1]
    assert max(map(len, text.splitlines())) <= 80
    relative = [abs(row.relative) for row in found.rows]
    assert relative == sorted(relative, reverse=True)
    assert not np.isnan(relative).any()


def test_time_and_start_values_and_the_number_of_peers_are_left_out() -> None:
    names = {row.parameter for row in sensitivities(compiled(AVERAGE)).rows}
    assert names == {
        *("device.mass", "device.damping", "cube.mass", "cube.damping"),
        *("contact.stiffness", "contact.damping", "coordination.stiffness", "coordination.damping"),
    }


def test_a_damping_of_nothing_has_the_derivative_of_what_it_adds_up_with() -> None:
    """A finger's tip and the device it holds move as one: their dampings act as their sum, at 0 too."""
    found = {row.parameter: row for row in sensitivities(compiled(FINGER)).rows}
    nothing, whole = found["finger.tip.damping"], found["device.damping"]
    assert nothing.value == 0
    assert nothing.derivative == pytest.approx(whole.derivative, rel=1e-7)
    assert all(np.isfinite([row.derivative, row.error]).all() for row in found.values())


def test_eigenvalues_that_change_alike_are_told_in_one_row() -> None:
    text = (SCENES / "experiment-average.yaml").read_text(encoding="utf-8").partition("\n")[2]
    lines = str(sensitivities(compiled(text))).splitlines()
    names = [line.split()[0] for line in lines[1:-1]]
    assert len(names) == len(set(names))
    assert not any("mode" in line or "+0.00e+00" in line for line in lines[1:-1])
    assert lines[-1] == "  2 eigenvalues share the radius: the largest of their changes decides"


def test_a_radius_below_every_float_has_no_derivative() -> None:
    """Rates of 10⁶/s over a frame of 1 s: e^(−10⁶) is no float."""
    found = sensitivities(
        compiled(
            "topology: gone\npeers: {user: {count: 1}}\n"
            "masses:\n  device: {mass: 0.1 g, damping: 100 N*s/m}\n"
            "  cube: {mass: 0.1 g, damping: 100 N*s/m}\n"
            "couplers: {pad: {type: SpringDamper, a: device, b: cube, stiffness: 1 N/um, damping: 1 N*s/m}}\n"
            "hands: {arm: {type: SpringDamperArm, flange: device, stiffness: 1 N/um, damping: 100 N*s/m}}\n"
        )
    )
    assert (found.radius, found.rows) == (0.0, ())
    assert str(found) == "  what moves it most: nothing, as every motion dies out to 0 within a frame"


@pytest.mark.parametrize("name", ["contact.stiffness", "coordination.stiffness"])
def test_where_more_is_free_than_nearby_no_derivative_is_wrong(name: str) -> None:
    """With `delays: own` what is free follows the stiffnesses; without one of them there is more of it."""
    graph = "graph: {edges: [[1, 2, 0.3], [1, 3, 0.3], [2, 3, 0.5]]}"
    text = replaced(
        MESH, ("delay: 8 ms}", f"delay: 8 ms, {graph}}}"), ("link: lan}", "link: lan, delays: own}")
    )
    text = replaced(text, (f"stiffness: {1000 if name[3] == 't' else 500} N/m", "stiffness: 0 N/m"))
    system = compiled(text)
    found = sensitivities(system)
    assert found.rows or found.note
    assert check_sensitivities(system, found) == ""


@pytest.mark.parametrize("name", ["cube.mass", "coordination.stiffness", "coordination.damping"])
def test_what_is_linearized_where_it_starts_is_differentiated_as_closely_as_what_is_linear(name: str) -> None:
    system = compiled((SCENES / "experiment-average.yaml").read_text(encoding="utf-8"))
    row = next(one for one in sensitivities(system).rows if one.parameter == name)
    assert row.derivative is not None
    assert row.error is not None
    assert row.error <= 1e-9 * abs(row.derivative)  # ten thousand times less than points tell
    step = 1e-4 * row.value
    low, high = (
        analyze(apply(system, [Override(Free(name), Fraction(row.value + way * step))])).spectral_radius
        for way in (-1, 1)
    )
    # Off by step²/6 of the third derivative, some 1e-8, and by the roundings of ρ over the step.
    assert abs((high - low) / (2 * step) - row.derivative) <= 1e-5 * abs(row.derivative)


def test_where_the_radius_is_large_it_is_differentiated_all_the_same() -> None:
    """A full mesh of 1,000: radius 6e7, of which a distance of 1e-10 is no float; by central differences."""
    system = compiled(replaced(MESH, ("count: 3", "count: 1000")))
    found = sensitivities(system)
    assert found.radius > 1e7 and found.active
    rows = {one.parameter: one for one in found.rows}
    for name in ("contact.stiffness", "coordination.stiffness", "cube.mass"):
        step = Fraction(rows[name].value) / 10**6
        ends = [Fraction(rows[name].value) + side * step for side in (-1, 1)]
        low, high = (analyze(apply(system, [Override(Free(name), end)])).spectral_radius for end in ends)
        assert rows[name].derivative == pytest.approx((high - low) / (2 * float(step)), rel=1e-6)


def test_without_parameters_it_is_said_that_there_is_none() -> None:
    system = compiled(AVERAGE)
    found = _differentiate(system, [], moved_systems(evaluator(system, []), np.empty(0)))
    assert found.rows == ()
    assert found.note == "what moves it most: not told: there is no parameter to vary"


def test_a_magnitude_without_a_derivative_is_told_in_six_digits() -> None:
    moved = SimpleNamespace(name="difference")
    values = np.array([4.6595006390654115e112 + 0j])
    told = _defective(cast(_Cluster, SimpleNamespace(values=values, moved=moved)))
    assert told.startswith("1 eigenvalue of difference at magnitude 4.6595e+112 shares")
