"""Claims about `apc.analysis.analysis`."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import casadi
import numpy as np
import pytest

from apc.analysis.analysis import analyze, prepare
from apc.compiler.compiled import Timing
from apc.compiler.errors import ApcError
from apc.frame.overrides import apply, parse_override
from tests.sites import MS, alone, columned, edged, grouped, linked, paper


def test_the_answer_is_plain_data() -> None:
    found = json.loads(json.dumps(analyze(paper()).to_dict(), allow_nan=False))
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
        "notes",
        "proof",
        "left_out",
        "translations",
        "rotations",
        "unfelt",
    ]
    assert (found["topology"], found["peers"], found["frame_s"]) == ("paper", 3, 0.008)
    assert (found["states_per_peer"], found["method"], found["stable"]) == (8, "modes", True)
    first = found["modes"][0]
    assert complex(*first["eigenvalue"]) == pytest.approx(
        first["magnitude"] * complex(*first["eigenvalue"]) / abs(complex(*first["eigenvalue"]))
    )
    assert set(first["participation"]) >= {"device.x", "contact.f(-1 ms)", "coordination.x sent(-8 ms)"}


def test_the_same_input_gives_the_same_answer() -> None:
    assert analyze(paper()) == analyze(paper())


def test_prepared_work_serves_other_numbers_and_other_times() -> None:
    system = paper()
    prepared = prepare(system)
    for text in ("coordination.stiffness=900 N/m", "lan.delay=4 ms", "haptic.period=0.5 ms"):
        changed = apply(system, [parse_override(system, text)])
        assert analyze(changed, prepared=prepared) == analyze(changed)


def test_another_order_of_coincident_events_can_change_the_radius() -> None:
    system = paper(comm=8 * MS)
    late = prepare(system, order=("send", "tick", "deliver", "act"))
    assert analyze(system, prepared=late).spectral_radius != analyze(system).spectral_radius


def test_a_mean_over_nobody_is_refused_and_a_sum_over_nobody_is_nothing() -> None:
    with pytest.raises(ApcError, match=r"E801 user\[1\] hears nobody over lan: there is no mean over nobody"):
        analyze(paper(peers=1))
    alone_in_a_sum = analyze(paper("sum", peers=1, kc=500.0))
    nobody_to_hear = analyze(paper("mean", peers=2, kc=500.0, kt=0.0))
    # Without a network the frame is one tick of the force clock, an eighth of the other.
    assert alone_in_a_sum.frame_s == 0.001
    assert alone_in_a_sum.spectral_radius**8 == pytest.approx(nobody_to_hear.spectral_radius, abs=1e-12)


def test_a_million_peers_cost_what_three_do() -> None:
    few, many = analyze(paper(peers=3)), analyze(paper(peers=1_000_000))
    assert many.peers == 1_000_000
    assert (len(many.modes), many.states_per_peer) == (len(few.modes), few.states_per_peer)


def test_a_billion_peers_in_groups_that_alternate_take_no_memory_a_peer() -> None:
    # As an array of peers each of these groups would take gigabytes.
    populations = (
        ("left", 400_000_000, {"contact.stiffness": 900.0}),
        ("mid", 600_000_000, {}),
        ("right", 3, {"contact.stiffness": 900.0}),
    )
    found = analyze(grouped(paper(kc=1000.0), *populations))
    assert found.peers == 1_000_000_003
    assert sum(mode.multiplicity for mode in found.modes) > 10**9


def test_the_dense_method_says_so() -> None:
    found = analyze(paper(peers=2), method="dense")
    assert found.method == "dense"
    assert {mode.shape for mode in found.modes} == {"dense"}
    assert found.states_per_peer == 8


def test_an_analysis_brings_in_no_symbolic_algebra_and_no_units() -> None:
    code = (
        "import sys\n"
        f"sys.path.insert(0, {str(Path(__file__).parent.parent)!r})\n"
        "from tests.sites import paper\n"
        "from apc.analysis.analysis import analyze\n"
        "analyze(paper())\n"
        "print(sorted({'sympy', 'pint', 'matplotlib'} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_one_peer_is_a_single_mode() -> None:
    found = analyze(alone(lambda x, u: -x + u, lambda x, u, m: -3 * x))
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
    assert (analyze(integral).rigid_modes, analyze(integral).verdict) == (0, "stable")
    free = alone(
        lambda x, u: -x + u, lambda x, u, m: casadi.vertcat(m[0], m[0]), outputs=("f", "kept"), memories=(1,)
    )
    assert (analyze(free).rigid_modes, analyze(free).verdict) == (
        1,
        "stable up to a common translation",
    )


def test_a_site_that_is_not_affine_is_said_to_be_linearized() -> None:
    cubic = alone(lambda x, u: -x - x**3 + u, lambda x, u, m: -3 * x)
    assert analyze(cubic).linearized
    assert not analyze(paper()).linearized


# ---- graphs, and peers that differ ----


def test_a_graph_that_splits_and_one_that_does_not_say_so() -> None:
    ring = analyze(linked(paper(peers=8), "ring"))
    assert (ring.method, ring.notes) == (
        "modes",
        ("5 systems, one an eigenvalue of the graph of lan (ring)",),
    )
    assert ring.to_dict()["notes"] == list(ring.notes)
    alike = analyze(columned(linked(paper(), "ring"), device__mass=[0.1, 0.2, 0.1]))
    assert (alike.method, alike.notes) == (
        "modes",
        ("2 systems, as peers that can change places move alike or apart",),
    )
    different = analyze(columned(linked(paper(), "ring"), device__mass=[0.1, 0.2, 0.3]))
    assert different.method == "dense"
    assert different.notes == ("all peers as one system: the peers on lan (ring) differ",)
    assert analyze(paper()).notes == ()


@pytest.mark.parametrize("graph", ["ring", "star", [(0, 1, 0.5), (1, 0, 0.25), (1, 2, 1.0), (2, 0, 3.0)]])
@pytest.mark.parametrize("values", [{}, {"kt": 0.0}, {"kc": 2500.0}])
def test_on_a_graph_the_split_and_the_whole_agree(graph: str, values: dict[str, float]) -> None:
    system = linked(paper(peers=4 if isinstance(graph, str) else 3, **values), graph)
    few, whole = analyze(system), analyze(system, method="dense")
    assert (few.method, whole.method) == ("modes", "dense")
    assert few.spectral_radius == pytest.approx(whole.spectral_radius, abs=1e-9)
    assert (few.verdict, few.rigid_modes) == (whole.verdict, whole.rigid_modes)
    assert few.spectral_radius_error < 1e-8
    assert sum(mode.multiplicity for mode in few.modes) == len(whole.modes)


def test_two_pairs_that_do_not_hear_each_other_translate_apart() -> None:
    pairs = [(0, 1, 1.0), (1, 0, 1.0), (2, 3, 1.0), (3, 2, 1.0)]
    found = analyze(linked(paper(peers=4), pairs))
    assert (found.rigid_modes, found.verdict) == (2, "stable up to a common translation")


def test_a_mean_whose_weights_add_up_to_nothing_is_refused() -> None:
    arcs = [(0, 1, 1.0), (2, 1, -1.0), (1, 0, 1.0), (1, 2, 1.0)]
    message = r"E802 the weights of what user\[2\] hears over lan add up to 0: there is no mean"
    for method in ("auto", "dense"):
        with pytest.raises(ApcError, match=message):
            analyze(linked(paper(), arcs), method=method)
        with pytest.raises(ApcError, match=r"E801 user\[1\] hears nobody over lan"):
            analyze(linked(paper(), arcs[:2]), method=method)
    assert analyze(linked(paper("sum"), arcs)).method in ("modes", "dense")


def test_peers_that_differ_only_at_the_start_are_equal_however_many() -> None:
    many = 10_000
    moved = columned(paper(peers=many), device__x__start=1e-6 * np.arange(many))
    found = analyze(moved)
    assert (found.method, found.spectral_radius) == ("modes", analyze(paper(peers=many)).spectral_radius)


def test_a_matrix_too_large_is_refused_and_so_is_a_method_that_cannot_serve() -> None:
    with pytest.raises(ApcError, match=r"E804 200 peers make one system of 1,600 states; the matrix of one"):
        analyze(paper(peers=200), method="dense")
    different = columned(linked(paper(), "ring"), device__mass=[0.1, 0.2, 0.3])
    with pytest.raises(ApcError, match=r"E850 method modes can't serve this scene: all peers as one system"):
        analyze(different, method="modes")
    with pytest.raises(ApcError, match=r"E850 method krylov can't serve this scene: user looks at each"):
        analyze(edged(paper()), method="krylov")
    with pytest.raises(ApcError, match=r"E850 method krylov .* all of 600 peers hear each other over lan"):
        analyze(columned(paper(peers=600), device__mass=np.linspace(0.1, 0.2, 600)), method="krylov")
    many = columned(linked(paper(peers=60), "ring"), device__mass=np.linspace(0.1, 0.2, 60))
    with pytest.raises(ApcError, match=r"E850 method determinant .* hear all others over lan"):
        analyze(many, method="determinant")


@pytest.mark.parametrize("operator", ["mean", "sum"])
def test_an_affine_edge_function_says_the_same_as_the_formula_it_stands_for(operator: str) -> None:
    gains = {"kt": 700.0, "bt": 2.0, "kc": 1500.0, "bc": 2.0}
    edge, plain = edged(paper(operator, **gains), operator), paper(operator, **gains)
    one, other = analyze(edge), analyze(plain)
    assert not one.linearized
    assert one.spectral_radius == pytest.approx(other.spectral_radius, abs=1e-12)
    assert (one.verdict, one.rigid_modes) == (other.verdict, other.rigid_modes)
    assert analyze(edged(paper(**gains), cubic=1.0)).linearized


def test_the_largest_of_equal_peers_has_no_linearization() -> None:
    message = r"E803 pull of user\[1\]: max over equal peers has no linearization"
    with pytest.raises(ApcError, match=message):
        analyze(edged(paper(), "max"))
    apart = columned(edged(paper(), "max"), cube__x__start=[0.0, 0.01, 0.02])
    assert analyze(apart).linearized
    # Two peers: the only other one is the largest, and the smallest, and the mean.
    two = [analyze(edged(paper(peers=2), operator)).spectral_radius for operator in ("max", "min", "mean")]
    assert two == pytest.approx([two[0]] * 3, abs=1e-12)


def test_the_largest_is_the_one_that_starts_furthest_away() -> None:
    """F_T = K max_j (x_i − x_j): everyone hears the lowest, the lowest the next: a graph of arcs."""
    starts = [0.03, 0.0, 0.01]
    arcs = [(1, 0, 1.0), (2, 1, 1.0), (1, 2, 1.0)]
    largest = columned(edged(paper(), "max"), cube__x__start=starts)
    assert analyze(largest).spectral_radius == pytest.approx(
        analyze(linked(paper(), arcs), method="dense").spectral_radius, abs=1e-10
    )


def test_a_group_of_its_own_delay_is_a_kind_with_a_timing_of_its_own() -> None:
    """Kinds alike but for the timing of a hold: with equal times they are one, otherwise not."""
    both = grouped(paper(kc=900.0), ("left", 1, {}), ("right", 2, {}))
    [kind] = both.kinds
    late = replace(kind, name="late", holds=tuple(replace(h, delay="late." + h.delay) for h in kind.holds))
    names = [hold.delay for hold in late.holds]
    for delay in (MS, 2 * MS):
        system = replace(
            both,
            kinds=(kind, late),
            groups=(both.groups[0], replace(both.groups[1], kind=1)),
            timings=(*both.timings, *(Timing(name, delay) for name in names)),
        )
        found, whole = analyze(system), analyze(system, method="dense")
        assert found.spectral_radius == pytest.approx(whole.spectral_radius, abs=1e-10)
        same = analyze(both).spectral_radius
        assert (found.spectral_radius == pytest.approx(same, abs=1e-10)) == (delay == MS)


def test_the_largest_takes_no_weights() -> None:
    cycle = [(0, 1, 0.7), (1, 2, 0.7), (2, 0, 0.7)]
    largest = analyze(linked(edged(paper(), "max"), cycle))
    plain = analyze(linked(paper("mean"), [(i, j, 1.0) for i, j, _ in cycle]))
    assert largest.method == "dense"
    assert largest.spectral_radius == pytest.approx(plain.spectral_radius, abs=1e-10)
