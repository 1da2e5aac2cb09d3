"""`settings`: words of a command line become a method, or one message."""

from __future__ import annotations

from fractions import Fraction

import pytest

from apc.simulation.settings import DEFAULT, Method, check_step, finer, parse_method
from tests.topologies import AVERAGE, compiled, told

MS = Fraction(1, 1000)


@pytest.mark.parametrize(
    ("text", "method"),
    [
        ("exact", Method("exact")),
        ("rk4:0.1 ms", Method("rk4", step=MS / 10)),
        ("rk4:250us", Method("rk4", step=MS / 4)),
        (" semi-implicit : 1 ms", Method("semi-implicit", step=MS)),
        ("cvodes:1e-8", Method("cvodes", tolerance=1e-8)),
    ],
)
def test_a_method_is_read_with_its_step_exact(text: str, method: Method) -> None:
    assert parse_method(text) == method


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "rk5:1 ms",
            "E910 the method wants one of exact, rk4, semi-implicit, cvodes, got rk5:1 ms. Write: rk4:0.1ms",
        ),
        ("", "E910 the method wants one of exact, rk4, semi-implicit, cvodes, got nothing. Write: exact"),
        (
            "exact:1 ms",
            "E910 the method wants exact alone, which has no step, got exact:1 ms. Write: exact",
        ),
        ("rk4", "E911 rk4 wants a step, got none. Write: rk4:0.1ms"),
        ("rk4:0 ms", "E911 the step of rk4 wants more than 0 s, got 0 ms. Write: rk4:0.1ms"),
        (
            "semi-implicit:-1 ms",
            "E911 the step of semi-implicit wants more than 0 s, got -1 ms. Write: semi-implicit:1ms",
        ),
        (
            "rk4:0.1",
            "E204 the step of rk4 wants s, got 0.1 (no unit). Write: rk4:0.1ms",
        ),
        (
            "cvodes:7",
            "E912 the relative tolerance of cvodes wants a number from 1e-12 to 0.01, got 7. "
            "Write: cvodes:1e-10",
        ),
        (
            "cvodes:nan",
            "E912 the relative tolerance of cvodes wants a number from 1e-12 to 0.01, got nan. "
            "Write: cvodes:1e-10",
        ),
    ],
)
def test_what_is_no_method_is_told_in_one_line(text: str, said: str) -> None:
    assert told(parse_method, text) == [f"--method: {said}"]


def test_a_step_that_the_scene_has_no_room_for_is_refused() -> None:
    system = compiled(AVERAGE)
    assert told(check_step, system, Method("rk4", step=2 * MS), MS, MS) == [
        "scene.yaml: E913 the step of rk4 wants at most the period of the fastest clock, 1 ms, "
        "got 2 ms. Write: --method rk4:1ms"
    ]
    [said] = told(check_step, system, Method("rk4", step=MS / 10**7), MS, MS)
    assert said.startswith("scene.yaml: E913 the step of rk4 wants at least 1e-06 ms,")
    check_step(system, Method("rk4", step=MS), MS, MS)
    check_step(system, DEFAULT, MS, MS)


def test_the_closer_run_has_half_the_step_or_a_hundredth_of_the_tolerance() -> None:
    assert finer(Method("rk4", step=MS), all_linear=True) == (Method("rk4", step=MS / 2), 16 / 15)
    assert finer(Method("semi-implicit", step=MS), all_linear=False)[1] == 2
    closer, factor = finer(Method("cvodes", tolerance=1e-6), all_linear=True)
    assert (closer.tolerance, factor) == (pytest.approx(1e-8), 1)
    assert finer(DEFAULT, all_linear=True)[0].perturbed
    assert finer(Method("exact"), all_linear=True)[0].perturbed
    assert not finer(DEFAULT, all_linear=False)[0].perturbed
