"""Claims about `apc.analysis.paper` and `apc.analysis.openloop`."""

from __future__ import annotations

import json
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linear_sum_assignment

from apc.analysis.analysis import lifted_groups
from apc.analysis.paper import PaperRoute, analyze_paper, paper_route
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.eigen.modes import dense
from tests import bruteforce
from tests.reference import OPERATORS, RADII
from tests.sites import MS, linked, paper
from tests.topologies import AVERAGE, MESH, SCENES, compiled, replaced, told

NONE = Fraction(0)

# An eigenvalue in so small a defective cluster, the queues running empty, is known to a root of rounding.
CLUSTER = 0.05


def assert_nonzero_eigenvalues_agree(route: PaperRoute, matrix: np.ndarray[Any, Any]) -> None:
    """Check that both have the same eigenvalues beyond the cluster at zero, to 1e-10."""
    direct = np.linalg.eigvals(matrix)
    mine, others = (v[np.abs(v) > CLUSTER] for v in (route.eigenvalues, direct))
    assert len(mine) == len(others) > 0
    apart = np.abs(mine[:, None] - others[None, :])
    assert apart[linear_sum_assignment(apart)].max() < 1e-10


def direct(system: CompiledSystem) -> np.ndarray[Any, Any]:
    return dense(*lifted_groups(system)).matrix


def test_the_shapes_are_the_papers() -> None:
    for text in (AVERAGE, MESH):
        route = paper_route(compiled(text))
        assert (route.a.shape, route.b.shape, route.c.shape) == ((12, 12), (12, 9), (18, 12))
        assert (route.a_d.shape, route.b_d.shape) == ((96, 96), (96, 51))
        assert (route.c_d.shape, route.d_d.shape, route.f_d.shape) == ((102, 96), (102, 51), (51, 102))
        assert np.linalg.matrix_rank(route.a_d.values) == 12
        # One tick of F_C and of each part of F_T a peer, and two numbers heard, are on their way.
        assert route.closed.shape == (96 + 3 * 5, 96 + 3 * 5)
        for one in (route.a, route.b_d, route.c_aug, route.d_aug, route.f_d, route.closed):
            assert one.values.shape == one.shape


@pytest.mark.parametrize(("peers", "ratio"), [(2, 8), (3, 1), (5, 2), (4, 8)])
def test_for_n_users_at_ratio_r_the_shapes_grow_as_stated(peers: int, ratio: int) -> None:
    route = paper_route(paper(peers=peers, network=ratio * MS, comm=ratio * MS))
    assert route.ratio == ratio
    assert route.a_d.shape == (4 * peers * ratio,) * 2
    assert route.b_d.shape == (4 * peers * ratio, 2 * peers * ratio + peers)
    assert route.c_d.shape == (4 * peers * ratio + 2 * peers, 4 * peers * ratio)


def test_rows_and_columns_are_named() -> None:
    route = paper_route(compiled(AVERAGE))
    assert route.b.columns == (
        *(f"user[{i}].{part}" for i in (1, 2, 3) for part in ("contact.f", "coordination.f own")),
        *(f"user[{i}].coordination.f received" for i in (1, 2, 3)),
    )
    assert route.c.rows[-2:] == (
        "user[3].mean(others.coordination.x)",
        "user[3].mean(others.coordination.v)",
    )
    assert (route.a_d.rows[0], route.a_d.rows[-1]) == ("user[1].device.x(-7 ms)", "user[3].cube.v(0 ms)")
    assert route.f_d.rows[6] == "user[1].contact.f(1 ms)"
    assert route.closed.columns[96] == "user[1].contact.f(-1 ms)"
    assert route.closed.columns[-1] == "user[3].mean(others.coordination.v)(-8 ms)"
    assert "B_D      96 × 51" in str(route)
    assert str(route.a).startswith("12 × 12: user[1].device.x … ")


def test_the_blocks_are_the_exponentials_they_stand_for() -> None:
    """x at tick j + 1 of the frame is e^{A(j+1)T} x(0) and, of a force at tick i, e^{A(j−i)T} ∫e^{As}ds B."""
    route = paper_route(compiled(AVERAGE))
    a, b, step = route.a.values, route.b.values, 0.001
    block = expm(np.block([[a, b], [np.zeros((9, 21))]]) * step)[:12]
    advance, force = block[:, :12], block[:, 12:]
    powers = [np.linalg.matrix_power(advance, j) for j in range(9)]
    for j in range(8):
        rows = route.b_d.values[12 * j : 12 * j + 12]
        assert route.a_d.values[12 * j : 12 * j + 12, 84:] == pytest.approx(powers[j + 1], abs=1e-14)
        assert not route.a_d.values[12 * j : 12 * j + 12, :84].any()
        for i in range(8):
            expected = powers[j - i] @ force[:, :6] if i <= j else np.zeros((12, 6))
            assert rows[:, 6 * i : 6 * i + 6] == pytest.approx(expected, abs=1e-14)
        slow = sum((powers[i] for i in range(j + 1)), np.zeros((12, 12))) @ force[:, 6:]
        assert rows[:, 48:] == pytest.approx(slow, abs=1e-14)
    # Outputs are before inputs: tick 0 sees no force of its frame, and what is heard none at all.
    assert not route.d_d.values[:12].any()
    assert not route.d_d.values[96:].any()
    assert route.d_d.values[12:24] == pytest.approx(route.b_d.values[:12], abs=0)


def test_the_feedback_is_eqs_3_10_and_11_with_b_t_in_its_place() -> None:
    damped = replaced(
        AVERAGE,
        ("stiffness: 1000 N/m", "stiffness: 1000 N/m, damping: 3 N*s/m"),
        ("stiffness: 500 N/m", "stiffness: 500 N/m, damping: 2 N*s/m"),
    )
    f = paper_route(compiled(damped)).f_d.values
    for tick in range(8):
        first = f[6 * tick : 6 * tick + 2, 12 * tick : 12 * tick + 4]
        assert first.tolist() == [[1000.0, 3.0, -1000.0, -3.0], [0.0, 0.0, 500.0, 2.0]]
    assert f[48, 96:98].tolist() == [-500.0, -2.0]
    assert np.count_nonzero(f) == 8 * 3 * 6 + 3 * 2


@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize("damping", [0.0, 2.0])
@pytest.mark.parametrize("comp", [NONE, MS])
@pytest.mark.parametrize("comm", [NONE, 8 * MS])
@pytest.mark.parametrize("own_delay", [False, True])
def test_its_nonzero_eigenvalues_are_those_of_the_direct_route(
    operator: str, damping: float, comp: Fraction, comm: Fraction, own_delay: bool
) -> None:
    system = paper(
        operator, kt=800.0, kc=1500.0, bt=damping, bc=damping, comp=comp, comm=comm, own_delay=own_delay
    )
    assert_nonzero_eigenvalues_agree(paper_route(system), direct(system))


@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize("peers", [2, 3, 5])
@pytest.mark.parametrize("ratio", [1, 2, 8])
def test_for_any_number_of_users_and_any_ratio(operator: str, peers: int, ratio: int) -> None:
    system = paper(operator, peers=peers, bt=2.0, bc=2.0, network=ratio * MS, comm=ratio * MS)
    assert_nonzero_eigenvalues_agree(paper_route(system), direct(system))


@pytest.mark.parametrize(("comp", "comm"), [(3, 16), (8, 0), (11, 24)])
@pytest.mark.parametrize("own_delay", [False, True])
def test_delays_of_several_ticks_and_of_more_than_a_frame(comp: int, comm: int, own_delay: bool) -> None:
    system = paper(comp=comp * MS, comm=comm * MS, bt=1.0, own_delay=own_delay)
    assert_nonzero_eigenvalues_agree(paper_route(system), direct(system))


def test_an_independent_computation_event_by_event_has_the_same_eigenvalues() -> None:
    scene = bruteforce.Scene(kt=700.0, bt=2.0, kc=1200.0, bc=2.0)
    route = paper_route(paper(kt=700.0, bt=2.0, kc=1200.0, bc=2.0))
    assert_nonzero_eigenvalues_agree(route, np.array(bruteforce.frame_matrix(scene)))


def test_other_graphs_and_delays_of_pairs_have_the_form_too() -> None:
    arcs = [(0, 1, 0.5), (1, 0, 0.25), (1, 2, 1.0), (2, 0, 3.0)]
    for system in (linked(paper(peers=4), "ring"), linked(paper(), arcs)):
        assert_nonzero_eigenvalues_agree(paper_route(system), direct(system))
    text = replaced(
        AVERAGE,
        ("  user: {count: 3}", "  near: {count: 2}\n  far: {count: 1, set: {device.mass: 0.2 kg}}"),
        ("delay: 8 ms}", "delay: 8 ms, delays: {near: {far: 24 ms}, far: {near: 24 ms}}}"),
    )
    system = compiled(text)
    route = paper_route(system)
    assert "near[1].mean(others.coordination.x) 3 frames late" in route.c.rows
    assert_nonzero_eigenvalues_agree(route, direct(system))


@pytest.mark.parametrize(
    ("operator", "radius"), [(OPERATORS[one], rho) for one, n, _, rho in RADII if n == 3]
)
def test_its_analysis_gives_the_verdict_and_the_radius(operator: str, radius: float) -> None:
    found = analyze_paper(paper(operator, kt=800.0, bt=2.0, kc=1500.0, bc=2.0))
    assert found.method == "paper"
    assert found.verdict == "stable up to a common translation"
    assert (found.stable, found.rigid_modes, found.states_per_peer) == (True, 1, 9)
    assert found.spectral_radius == pytest.approx(radius, abs=1e-8)
    assert 0 < found.spectral_radius_error < 1e-7
    assert found.notes == ("A_cl is 111 × 111; 84 of its columns are zero and as many eigenvalues with them",)
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False))["method"] == "paper"
    assert analyze_paper(paper(operator, kc=4000.0)).verdict == "unstable"


def test_its_bound_holds_the_radius_of_the_direct_route() -> None:
    for kt in (200.0, 700.0, 1500.0):
        system = paper(kt=kt, bt=1.0)
        found = analyze_paper(system)
        values = np.sort(np.abs(np.linalg.eigvals(direct(system))))[::-1]
        others = np.delete(values, np.argmin(np.abs(values - 1.0)))
        assert abs(found.spectral_radius - others[0]) < found.spectral_radius_error


def test_at_the_boundary_it_says_that_its_matrix_is_not_proved() -> None:
    found = analyze_paper(paper(kt=1096.410868364942))
    assert found.stable is None
    assert found.verdict.startswith("undecided")
    assert found.notes[1:] == ("paper: not proved, as its matrix was not composed from sites",)


def test_what_drifts_and_what_translates_apart_is_told_as_by_the_direct_route() -> None:
    loose = replaced(AVERAGE, ("stiffness: 500 N/m", "stiffness: 0 N/m, damping: 3 N*s/m"))
    assert analyze_paper(compiled(loose)).rigid_modes == 3
    sliding = replaced(
        loose.replace("damping: 5 N*s/m", "damping: 0 N*s/m"),
        ("stiffness: 1000 N/m", "stiffness: 100 N/m, damping: 6 N*s/m"),
    )
    found = analyze_paper(compiled(sliding))
    assert (found.verdict, found.stable, found.rigid_modes) == ("drifts", False, 3)
    assert found.spectral_radius == pytest.approx(0.8792835184043, abs=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "missing"),
    [
        ("haptic: 1 ms", "haptic: 1.6 ms", "a computational delay of contact.f of whole ticks of haptic"),
        ("network: 8 ms", "network: 7.5 ms", "a network period that is a whole multiple of that of haptic"),
        ("network: 8 ms", "network: {period: 8 ms, phase: 0.5 ms}", "ticks of network that fall on ticks of"),
        ("delay: 8 ms}", "delay: 9 ms}", "a delay of lan of whole ticks of network"),
        ("count: 3", "count: 90", "more than 1,800 rows"),
    ],
)
def test_a_scene_of_another_form_is_told_what_is_missing(old: str, new: str, missing: str) -> None:
    [message] = told(paper_route, compiled(AVERAGE.replace(old, new)))
    assert missing in message


def test_a_scene_that_is_not_linear_or_has_two_clocks_of_forces_is_told_so() -> None:
    [message] = told(paper_route, compiled((SCENES / "experiment-average.yaml").read_text()))
    assert "E861" in message
    assert "missing: linear equations (right and left is not linear)" in message
    with pytest.raises(ApcError, match=r"one clock of forces \(here are haptic and slow\)"):
        paper_route(compiled((SCENES / "mixed-clocks.yaml").read_text()))
    alone = paper("sum", peers=1)
    with pytest.raises(ApcError, match=r"one network clock \(here is none\)"):
        paper_route(alone)
