"""The independent engine of fifty digits against computations that share nothing with it, and balls."""

from __future__ import annotations

import ast
import json
import math
from fractions import Fraction
from pathlib import Path
from typing import Any

import flint
import numpy as np
import pytest

from apc.benchmark.truth import spectral_truth as of_balls
from apc.compiler.compiled import CompiledSystem
from apc.compiler.pipeline import compile_topology
from apc.eigen.balls import precision
from tests.bench.contact_reference import Bounce, positions, reference
from tests.bruteforce import Scene, as_ball, frame_matrix
from tests.eventwise import experiment, play
from tests.fifty_digits import events
from tests.fifty_digits import truth as fifty_digits
from tests.fifty_digits.events import refusal
from tests.fifty_digits.truth import Truth, classes_of, exact_course, spectral_truth
from tests.sites import MS, columned, edged, grouped, linked, paper
from tests.topologies import AVERAGE, MESH, ROOT, SCENES, compiled, replaced


def _radius(scene: Scene, rigid: int) -> flint.arb:
    """Return the radius by the brute force of the tests, which knows the scene and no compiled function."""
    with precision(600):
        rows = frame_matrix(scene, number=as_ball, exp=lambda value: value.exp())
        values = flint.acb_mat([[flint.acb(e.mid()) for e in row] for row in rows]).eig(algorithm="approx")
        values.sort(key=lambda value: float(abs(value - 1).mid()))
        return max(abs(value).mid() for value in values[rigid:])


@pytest.mark.few(2)
@pytest.mark.parametrize("name", ["ring-of-eight", "star-lecture", "mixed-clocks", "experiment-mesh"])
def test_what_bench_compares_with_is_the_truth_of_the_independent_engine(name: str) -> None:
    system = compile_topology(SCENES / f"{name}.yaml")
    found = of_balls(system)
    assert not isinstance(found, str), found
    assert found.digits[:45] == _truth(system).digits[:45]


def test_what_bench_compares_with_is_the_stored_truth_of_hard_cases() -> None:
    folder = ROOT / "tests" / "hard"
    stored = json.loads((folder / "truths.json").read_text(encoding="utf-8"))
    for name in (
        "boundary-inside-13",
        "coasting",
        "high-rate-ratio",
        "nearly-defective",
        "three-large-groups",
    ):
        found = of_balls(compile_topology(folder / f"{name}.yaml"))
        assert not isinstance(found, str), found
        assert found.digits[:45] == stored[name]["spectral_radius"][:45]


def test_weights_known_as_floats_only_are_no_balls_truth() -> None:
    """A graph whose eigenvalues are floats is one whole system; its truth is the engine's too."""
    arcs = [(0, 1, 1.0), (1, 0, 0.5), (2, 1, 2.0), (1, 2, 0.25)]
    system = linked(paper(peers=3), arcs)
    found = of_balls(system)
    assert not isinstance(found, str), found
    assert found.digits[:45] == _truth(system).digits[:45]


def test_what_is_too_large_for_balls_says_so() -> None:
    many = columned(paper(peers=40), device__mass=[0.1 + 0.01 * i for i in range(40)])
    assert str(of_balls(many)) == "160 states of motion of different peers take too long at 50 digits"
    ring = linked(paper(peers=1000), "ring")
    assert str(of_balls(ring)) == "1,000 peers on a graph take too long at 50 digits"
    late = compile_topology(ROOT / "tests" / "hard" / "very-long-delay.yaml")
    assert str(of_balls(late)) == "eigenvalues of 2,006 states together take too long at 50 digits"


def _truth(system: CompiledSystem) -> Truth:
    found = spectral_truth(system)
    assert isinstance(found, Truth), found
    return found


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"operator": "sum", "peers": 2, "bt": 2.0, "bc": 1.0},
        {"comp": MS / 7, "comm": MS * 22 / 7},
        {"comp": Fraction(0), "comm": Fraction(0), "own_delay": True},
        {"peers": 1, "operator": "sum", "network": Fraction(1, 90), "comm": Fraction(1, 45)},
        {"haptic_phase": MS / 2, "network_phase": MS * 3},
    ],
)
def test_fifty_digits_are_those_of_the_brute_force(values: dict[str, Any]) -> None:
    scene = {"kt": 300.0, **values}
    found = _truth(paper(**scene))
    assert found.rigid == 1
    with precision(600):
        assert float(abs(found.radius - _radius(Scene(**scene), 1))) < 1e-50


def test_a_graph_with_weights_is_followed_arc_by_arc() -> None:
    arcs = [(0, 1, 1.0), (1, 0, 0.5), (2, 1, 2.0), (1, 2, 0.25)]
    found = _truth(linked(paper(peers=3), arcs))
    weights = {(i, j): weight for i, j, weight in arcs}
    with precision(600):
        assert float(abs(found.radius - _radius(Scene(weights=weights), 1))) < 1e-50


@pytest.mark.parametrize("operator", ["mean", "sum"])
def test_equal_peers_by_their_classes_are_all_peers(operator: str) -> None:
    system = paper(operator, peers=4, kt=200.0)
    assert classes_of(system).counts == (4,)
    with precision(600):
        expected = _radius(Scene(operator=operator, peers=4, kt=200.0), 1)
        assert float(abs(_truth(system).radius - expected)) < 1e-50


def test_groups_and_stars_fall_into_classes() -> None:
    two = grouped(paper(), ("one", 1, {"device.mass": 0.3}), ("many", 10**6, {}))
    assert classes_of(two).counts == (1, 10**6)
    star = linked(paper(peers=5), "star")
    assert classes_of(star).counts == (1, 4)
    ring = linked(paper(peers=5), "ring")
    assert classes_of(ring).counts == (1, 1, 1, 1, 1)
    weights = dict.fromkeys(((0, 1), (0, 2), (0, 3), (0, 4), (1, 0), (2, 0), (3, 0), (4, 0)), 1.0)
    with precision(600):
        assert float(abs(_truth(star).radius - _radius(Scene(peers=5, weights=weights), 1))) < 1e-50


def test_a_course_is_that_of_stepping_by_hand() -> None:
    """The experiment, with contacts that open and close: positions and velocities at every tick."""
    for name, operator in (("average", "mean"), ("mesh", "sum")):
        system = compiled((SCENES / f"experiment-{name}.yaml").read_text(encoding="utf-8"))
        found = exact_course(system, Fraction(1, 5))
        assert not isinstance(found, str)
        names, rows = found
        assert names[0] == "right[1].device.x"
        by_hand = np.array(play(experiment(operator), Fraction(1, 5)))[:, 1:].reshape(len(rows), 3, 6)
        np.testing.assert_allclose(rows.reshape(len(rows), 3, 4), by_hand[:, :, :4], rtol=0, atol=1e-12)


def test_what_has_no_reference_says_why() -> None:
    lossy = replaced(AVERAGE, ("delay: 8 ms}\nstudies", "delay: 8 ms, loss: 2 %}\nstudies"))
    assert refusal(compiled(lossy), in_time=True) == "packets get lost or come late by chance"
    assert refusal(edged(paper()), in_time=False) == "user looks at each sender by itself"
    many = columned(paper(peers=20), device__mass=[0.1 + 0.01 * i for i in range(20)])
    assert str(spectral_truth(many)) == "80 states of motion take too long at 50 digits"


def test_the_mesh_is_the_average_with_twice_the_gain() -> None:
    """Three peers: (N − 1) K_T in the one is K_T in the other, to every digit."""
    mesh = compiled(replaced(MESH, ("stiffness: 500 N/m", "stiffness: 250 N/m")))
    with precision(600):
        assert float(abs(_truth(mesh).radius - _truth(compiled(AVERAGE)).radius)) < 1e-50


def test_the_reference_shares_with_the_runtime_what_it_says_and_no_more() -> None:
    shared = set()
    for module in (events, fifty_digits):
        tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            module_name = (node.module or "") if isinstance(node, ast.ImportFrom) else ""
            if module_name.startswith("apc.") and "apc.compiler" not in module_name:
                shared |= {alias.name for alias in node.names}  # type: ignore[attr-defined] # it is an import
    functions = {"evaluate_exact", "is_rational", "guards_of", "rational_ball", "precision"}
    assert shared == functions | {"resolve", "exact_numbers", "arcs", "ROW"}
    assert all(name in str(events.__doc__) for name in shared)


def test_before_it_touches_the_device_flies_as_in_closed_form() -> None:
    rows = positions(Bounce(3e6, 1e6), 7)  # they touch after 7.3 ms
    mass, drag, hand, x_0, v_0 = 0.1, 0.1, 3.0, -3e-3, 0.3
    for tick, (x, ball) in enumerate(rows.tolist()):
        t = tick * 1e-3
        flown = mass / drag * (v_0 - hand / drag) * -math.expm1(-drag * t / mass)
        assert x == pytest.approx(x_0 + hand / drag * t + flown, abs=1e-15)
        assert ball == 0


def test_a_contact_conserves_what_nothing_takes_away() -> None:
    """Without damping, seat and hand: momentum, and the speeds after an elastic collision."""
    bounce = Bounce(3e6, 0.0, device=(0.1, 0.0), ball=(0.3, 0.0), seat=(0.0, 0.0), hand=0.0)
    rows = positions(bounce, 20)
    before, after = rows[1] - rows[0], rows[-1] - rows[-2]
    assert before == pytest.approx([3e-4, 0], abs=1e-17)
    assert after == pytest.approx([-1.5e-4, 1.5e-4], rel=1e-11)


def test_a_soft_contact_is_certain_to_thirteen_digits() -> None:
    assert reference(Bounce(2e4, 1e4), 60)[1] < 1e-13
