"""Claims about `apc.runtime.analysis`."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from pathlib import Path

import casadi
import pytest

from apc.runtime.analysis import analyze_dense, analyze_modes, prepare
from apc.runtime.parameters import apply, parse_override
from tests.sites import MS, alone, paper


def test_the_answer_is_plain_data() -> None:
    found = json.loads(json.dumps(analyze_modes(paper()).to_dict(), allow_nan=False))
    assert list(found) == [
        "topology",
        "peers",
        "frame_s",
        "states_per_peer",
        "method",
        "verdict",
        "stable",
        "spectral_radius",
        "spectral_radius_error",
        "rigid_modes",
        "modes",
        "linearized",
    ]
    assert (found["topology"], found["peers"], found["frame_s"]) == ("paper", 3, 0.008)
    assert (found["states_per_peer"], found["method"], found["stable"]) == (8, "modes", True)
    first = found["modes"][0]
    assert complex(*first["eigenvalue"]) == pytest.approx(
        first["magnitude"] * complex(*first["eigenvalue"]) / abs(complex(*first["eigenvalue"]))
    )
    assert set(first["participation"]) >= {"device.x", "contact.f(-1 ms)", "coordination.x sent(-8 ms)"}


def test_the_same_input_gives_the_same_answer() -> None:
    assert analyze_modes(paper()) == analyze_modes(paper())


def test_prepared_work_serves_other_numbers_and_other_times() -> None:
    system = paper()
    prepared = prepare(system)
    for text in ("coordination.stiffness=900 N/m", "lan.delay=4 ms", "haptic.period=0.5 ms"):
        changed = apply(system, [parse_override(system, text)])
        assert analyze_modes(changed, prepared=prepared) == analyze_modes(changed)


def test_another_order_of_coincident_events_can_change_the_radius() -> None:
    system = paper(comm=8 * MS)
    late = prepare(system, order=("send", "tick", "deliver", "act"))
    assert analyze_modes(system, prepared=late).spectral_radius != analyze_modes(system).spectral_radius


def test_one_peer_alone_hears_nobody_and_a_scene_that_says_otherwise_is_ours_to_refuse() -> None:
    with pytest.raises(AssertionError, match="nobody else sends"):
        analyze_modes(paper(peers=1))


def test_a_million_peers_cost_what_three_do() -> None:
    few, many = paper(peers=3), paper(peers=1_000_000)
    analyze_modes(few)
    started = time.perf_counter()
    assert analyze_modes(many).peers == 1_000_000
    assert time.perf_counter() - started < 2.0  # measured 0.02 s


def test_the_dense_method_says_so() -> None:
    found = analyze_dense(paper(peers=2))
    assert found.method == "dense"
    assert {mode.shape for mode in found.modes} == {"dense"}
    assert found.states_per_peer == 8


def test_an_analysis_brings_in_no_symbolic_algebra_and_no_units() -> None:
    code = (
        "import sys\n"
        f"sys.path.insert(0, {str(Path(__file__).parent.parent)!r})\n"
        "from tests.sites import paper\n"
        "from apc.runtime.analysis import analyze_modes\n"
        "analyze_modes(paper())\n"
        "print(sorted({'sympy', 'pint', 'matplotlib'} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_one_peer_is_a_single_mode() -> None:
    found = analyze_modes(alone(lambda x, u: -x + u, lambda x, u, m: -3 * x))
    [mode] = found.modes
    assert (mode.shape, found.verdict, found.peers) == ("single", "stable", 1)
    assert mode.eigenvalue == pytest.approx(math.exp(-0.001) - 3 * -math.expm1(-0.001), rel=1e-14)


def test_an_integrator_in_a_memory_is_rigid_only_if_nothing_reads_its_input() -> None:
    """m[k] = m[k−1] + x, u = −m: integral action, stable; without the spring of x it would stay put."""
    integral = alone(
        lambda x, u: -x + u,
        lambda x, u, m: casadi.vertcat(-0.001 * m[0], m[0] + x),
        outputs=("f", "sum"),
        memories=(1,),
    )
    assert (analyze_modes(integral).rigid_modes, analyze_modes(integral).verdict) == (0, "stable")
    free = alone(
        lambda x, u: -x + u, lambda x, u, m: casadi.vertcat(m[0], m[0]), outputs=("f", "kept"), memories=(1,)
    )
    assert (analyze_modes(free).rigid_modes, analyze_modes(free).verdict) == (
        1,
        "stable up to a common translation",
    )


def test_a_site_that_is_not_affine_is_said_to_be_linearized() -> None:
    cubic = alone(lambda x, u: -x - x**3 + u, lambda x, u, m: -3 * x)
    assert analyze_modes(cubic).linearized
    assert not analyze_modes(paper()).linearized
