"""The lifted matrices of Rakhsha and Constantinescu, eqs. (18) to (20), with rows and columns named.

That their radius is true is among `tests/test_truths.py`.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from apc.extensions.paper_method.lifted_matrices import analyze_paper, paper_method
from tests.sites import paper
from tests.topologies import AVERAGE, MESH, compiled, messages_of, replaced


def test_the_shapes_are_the_papers() -> None:
    for text in (AVERAGE, MESH):
        route = paper_method(compiled(text))
        assert (route.a.shape, route.b.shape, route.c.shape) == ((12, 12), (12, 9), (18, 12))
        assert (route.a_d.shape, route.b_d.shape) == ((96, 96), (96, 51))
        assert (route.c_d.shape, route.d_d.shape, route.f_d.shape) == ((102, 96), (102, 51), (51, 102))
        assert np.linalg.matrix_rank(route.a_d.values) == 12
        # One tick of F_C and of each part of F_T a peer, and two numbers heard, are on their way.
        assert route.closed.shape == (96 + 3 * 5, 96 + 3 * 5)
        for one in (route.a, route.b_d, route.c_aug, route.d_aug, route.f_d, route.closed):
            assert one.values.shape == one.shape


def test_rows_and_columns_are_named() -> None:
    route = paper_method(compiled(AVERAGE))
    assert route.b.columns == (
        *(f"user[{i}].{part}" for i in (1, 2, 3) for part in ("contact.f", "coordination.f own")),
        *(f"user[{i}].coordination.f received" for i in (1, 2, 3)),
    )
    assert route.c.rows[-2:] == ("user[3].mean(others.coordination.x)", "user[3].mean(others.coordination.v)")
    assert (route.a_d.rows[0], route.a_d.rows[-1]) == ("user[1].device.x(-7 ms)", "user[3].cube.v(0 ms)")
    assert route.f_d.rows[6] == "user[1].contact.f(1 ms)"
    assert route.closed.columns[96] == "user[1].contact.f(-1 ms)"
    assert route.closed.columns[-1] == "user[3].mean(others.coordination.v)(-8 ms)"
    assert "B_D      96 × 51" in str(route)
    assert str(route.a).startswith("12 × 12: user[1].device.x … ")


def test_the_feedback_is_eqs_3_10_and_11_with_b_t_in_its_place() -> None:
    damped = replaced(
        AVERAGE,
        ("stiffness: 1000 N/m", "stiffness: 1000 N/m, damping: 3 N*s/m"),
        ("stiffness: 500 N/m", "stiffness: 500 N/m, damping: 2 N*s/m"),
    )
    f = paper_method(compiled(damped)).f_d.values
    for tick in range(8):
        first = f[6 * tick : 6 * tick + 2, 12 * tick : 12 * tick + 4]
        assert first.tolist() == [[1000.0, 3.0, -1000.0, -3.0], [0.0, 0.0, 500.0, 2.0]]
    assert f[48, 96:98].tolist() == [-500.0, -2.0]
    assert np.count_nonzero(f) == 8 * 3 * 6 + 3 * 2


def test_at_the_boundary_it_says_that_its_matrix_is_not_proved() -> None:
    found = analyze_paper(paper(kt=1096.410868364942))
    assert found.stable is None
    assert found.verdict.startswith("undecided")
    assert tuple(map(str, found.notes[1:])) == (
        "paper: not proved, as its matrix was not composed from those of peers",
    )


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
def test_a_topology_of_another_form_is_told_what_is_missing(old: str, new: str, missing: str) -> None:
    [message] = messages_of(paper_method, compiled(AVERAGE.replace(old, new)))
    assert missing in message


def test_the_stacked_matrices_do_what_the_ticks_of_a_frame_do_one_by_one() -> None:
    """Whatever the state and the forces, A_D x + B_D u holds the states after each tick in order."""
    route = paper_method(compiled(AVERAGE))
    step = expm(np.block([[route.a.values, route.b.values], [np.zeros((9, 21))]]) * 0.001)[:12]
    generator = np.random.default_rng(3)
    x, fast, slow = generator.normal(size=12), generator.normal(size=(8, 6)), generator.normal(size=3)
    stacked = route.a_d.values[:, 84:] @ x + route.b_d.values @ np.concatenate([fast.ravel(), slow])
    assert not route.a_d.values[:, :84].any()
    for tick, forces in enumerate(fast):
        x = step @ np.concatenate([x, forces, slow])
        assert stacked[12 * tick : 12 * tick + 12] == pytest.approx(x, abs=1e-14)
    # Outputs are before inputs: tick 0 sees no force of its frame, and what is heard none at all.
    assert not route.d_d.values[:12].any()
    assert not route.d_d.values[96:].any()
    assert route.d_d.values[12:24] == pytest.approx(route.b_d.values[:12], abs=0)
