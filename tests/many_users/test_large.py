"""Very many users: small determinants, sparse matrices, rings of which few systems decide."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from apc.analysis.analysis import Analysis, analyze, lifted_groups
from apc.eigen.balls import precision
from apc.eigen.bordered import (
    beyond_circle,
    map_balls,
    proved_zero,
    side_by_side,
    wire_balls,
    wires_of,
)
from apc.eigen.closing import Loop, close_loop
from apc.eigen.graph_loops import graph_loop, graph_scale
from apc.eigen.graph_modes import ring_mode, ring_values
from apc.eigen.modes import arrange
from apc.eigen.peer_group import used_ways
from apc.eigen.spectrum import Spectrum
from apc.large.determinant_spectrum import solve_populations
from apc.large.rings import find_extremes
from apc.large.translation import count_translations
from tests.populations import crowded, different
from tests.sites import MS, columned, grouped, linked, paper
from tests.topologies import AVERAGE, compiled, replaced

VARIED_RINGS: list[dict[str, Any]] = [
    {},
    {"comp": Fraction(0), "comm": Fraction(0), "kt": 2000.0},
    {"kc": 2400.0},
    {"kc": 1500.0, "kt": 5000.0},
]


VARIED: list[dict[str, Any]] = [
    {},
    {"operator": "sum"},
    {"kc": 2400.0},
    {"kt": 6000.0},
    {"comp": Fraction(0), "comm": Fraction(0)},
    {"comp": MS * 5 / 2, "comm": 4 * MS},
    {"haptic": 2 * MS, "network": 3 * MS},
    {"haptic": 3 * MS, "network": 2 * MS, "comp": Fraction(0), "comm": Fraction(0), "operator": "sum"},
    {"comm": 30 * MS},
    {"kt": 0.0},
]


def _solved(system: Any) -> Spectrum:
    listed, exchange = crowded(system)
    return solve_populations(listed, exchange, rigid=count_translations(listed, exchange) or 0)


@pytest.mark.few(10)
@pytest.mark.parametrize("values", VARIED)
@pytest.mark.parametrize("peers", [2, 5, 12])
def test_different_peers_have_the_spectral_radius_of_their_whole_matrix(
    peers: int, values: dict[str, Any]
) -> None:
    values = dict(values)
    system = different(peers, values.pop("operator", "mean"), **values)
    _agree(_solved(system), analyze(system, method="dense"))


@pytest.mark.parametrize("delays", [{}, {("left", "right"): 12 * MS, ("right", "left"): 3 * MS}])
def test_groups_with_delays_of_their_own_are_one_determinant(delays: dict[tuple[str, str], Fraction]) -> None:
    base = grouped(paper(kt=300.0), ("left", 3, {"device.mass": 0.3}), ("right", 2, {"cube.mass": 0.1}))
    system = linked(base, delays=delays)
    _agree(_solved(system), analyze(system, method="dense"))


def test_what_is_said_to_be_rigid_and_is_not_leaves_the_verdict_open() -> None:
    listed, exchange = crowded(different(6))
    wrong = solve_populations(listed, exchange, rigid=0)
    assert wrong.stable is None


def _agree(found: Spectrum | Analysis, whole: Analysis) -> None:
    """Assert that the radius is the whole's within its bound, and every mode one of the whole."""
    assert (found.verdict, found.rigid_modes) == (whole.verdict, whole.rigid_modes)
    apart = abs(found.spectral_radius - whole.spectral_radius)
    assert apart <= found.spectral_radius_error + whole.spectral_radius_error
    assert found.spectral_radius_error < 1e-7
    for mode in found.modes:
        same = min(whole.modes, key=lambda one: abs(one.eigenvalue - mode.eigenvalue))
        assert abs(same.eigenvalue - mode.eigenvalue) <= mode.error + same.error
        assert mode.frequency_hz == pytest.approx(same.frequency_hz, abs=1e-8)
        assert mode.damping_ratio == pytest.approx(same.damping_ratio, abs=1e-9)
    if found.modes:  # the shares of all peers together
        shares: dict[str, float] = {}
        first = min(whole.modes, key=lambda one: abs(one.eigenvalue - found.modes[0].eigenvalue))
        for name, share in first.participation:
            name = name.split("].")[-1]
            name = name.partition("(")[0] if "sent(" in name else name
            shares[name] = shares.get(name, 0.0) + share
        for name, share in found.modes[0].participation:
            assert share == pytest.approx(shares[name.split("user.")[-1]], abs=1e-7), name


@pytest.mark.few(2)
@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize("graph", ["ring", "star"])
@pytest.mark.parametrize("values", [{}, {"kc": 2500.0}])
def test_the_largest_modes_of_a_sparse_matrix_are_those_of_the_whole(
    operator: str, graph: str, values: dict[str, Any]
) -> None:
    system = different(16, operator, graph, **values)
    _agree(analyze(system, method="krylov"), analyze(system, method="dense"))


PATH = [(i, i + 1, 0.5 + i) for i in range(5)] + [(i + 1, i, 1.0) for i in range(5)]


@pytest.mark.parametrize("loose", ["contact__stiffness", "none"])
def test_a_device_that_hangs_loose_translates_by_itself(loose: str) -> None:
    """Devices nobody holds, and copies that only move together, on a path of two parts."""
    arcs = [arc for arc in PATH if {arc[0], arc[1]} != {2, 3}]
    system = different(6, graph=arcs, kc=0.0, bc=0.0) if loose != "none" else different(6, graph=arcs)
    found, whole = analyze(system, method="krylov"), analyze(system, method="dense")
    assert (found.verdict, found.rigid_modes) == (whole.verdict, whole.rigid_modes)
    assert found.rigid_modes == (8 if loose != "none" else 2)
    assert found.spectral_radius == pytest.approx(whole.spectral_radius, abs=1e-10)


def test_what_drifts_leaves_the_radius_open() -> None:
    frictionless = {"device.damping": 0.0, "cube.damping": 0.0}
    base = paper(peers=4, comp=Fraction(0), kt=0.0, bt=2.0, kc=500.0, bc=2.0)
    found = analyze(linked(grouped(base, ("user", 4, frictionless)), "ring"), method="krylov")
    assert found.stable is None
    assert found.spectral_radius_error >= found.spectral_radius
    assert any("drifts" in note for note in found.notes)


def test_a_peer_that_differs_in_what_it_is_free_to_do_leaves_the_verdict_open() -> None:
    system = columned(linked(paper(peers=5), "ring"), contact__stiffness=[0.0, *[1000.0] * 4])
    found = analyze(system, method="krylov")
    assert found.stable is None
    assert found.spectral_radius_error >= found.spectral_radius


@pytest.mark.few(2)
@pytest.mark.parametrize("values", VARIED_RINGS)
def test_no_system_left_out_is_above_the_bound(values: dict[str, Any]) -> None:
    """Every system of a ring of 301, one by one."""
    peers = 301
    groups, exchange = lifted_groups(linked(paper(peers=peers, **values), "ring"))
    [group] = groups
    scale = graph_scale(group, used_ways([group.schedule]), exchange)
    weights = np.array([float(scale.weights[one.way]) for one in group.schedule.heard])
    closed = [close_loop(graph_loop(group, ring_mode(k, peers, mean=False), scale)) for k in range(1, 151)]
    radii = np.array([np.abs(np.linalg.eigvals(one.matrix)).max() for one in closed])
    assert not scale.by_mean
    n = len(closed[0].matrix)
    found = find_extremes(group, weights, ring_values(peers, mean=False)[1:], np.zeros((n, 0)))
    assert found.proved
    assert int(np.argmax(radii)) in found.places.tolist()
    left_out = np.setdiff1d(np.arange(len(radii)), found.places)
    assert radii[left_out].max() <= found.below < radii.max()
    assert len(found.places) <= 4


def test_a_ring_of_a_hundred_thousand_peers_solves_a_handful_of_systems() -> None:
    system = linked(paper(peers=100_000), "ring")
    found = analyze(system)
    assert (found.verdict, found.rigid_modes) == ("stable up to a common translation", 1)
    # The slowest difference of neighbours: the eigenvalue of the second system, 2π/N apart from the first.
    mu = 1 - np.cos(2 * np.pi / 100_000)
    slow = 1 - analyze(linked(paper(peers=1000), "ring")).spectral_radius
    assert 1 - found.spectral_radius == pytest.approx(slow * mu / (1 - np.cos(2 * np.pi / 1000)), rel=1e-3)
    assert found.spectral_radius_error < 1e-12
    assert found.notes == (
        "50,001 systems, one an eigenvalue of the graph of lan (ring): 2 of them are solved, "
        "all others are shown to die out faster",
    )


LATE = replaced(AVERAGE, ("delay: 8 ms}", "delay: 40 ms}"))


DIFFERENT = replaced(
    LATE, ("{count: 3}", "{count: 2}\n  other: {count: 1, set: {contact.stiffness: 700 N/m}}")
)


def _loops(text: str) -> tuple[Loop, ...]:
    return arrange(*lifted_groups(compiled(text))).loops


@pytest.mark.few(5)
@pytest.mark.parametrize("text", [AVERAGE, LATE, DIFFERENT])
@pytest.mark.parametrize("radius", [0.7, 0.9, 0.99, 1 - 1e-6, 1 + 1e-6])
def test_the_zeros_beyond_a_circle_are_counted(text: str, radius: float) -> None:
    for loop in _loops(text):
        wires = wires_of(loop.sites, loop.coupling, loop.doubts)
        maps, errors = (
            side_by_side(blocks)
            for blocks in zip(*((one.lifted, one.lifted.error) for one in loop.sites), strict=True)
        )
        values = np.linalg.eigvals(close_loop(loop).matrix)
        found = beyond_circle(maps, errors, wires, radius, np.array([1.0]))
        assert found == int((np.abs(values) > radius).sum())


@pytest.mark.parametrize("text", [AVERAGE, LATE, DIFFERENT])
def test_every_simple_eigenvalue_is_held_in_a_ball(text: str) -> None:
    for loop in _loops(text):
        values = np.linalg.eigvals(close_loop(loop).matrix)
        for value in values[np.abs(values) > 0.5].tolist():
            with precision(128):
                ball = proved_zero(map_balls(loop), wire_balls(loop), value)
                assert ball is not None and ball.rel_accuracy_bits() > 80
            assert complex(ball) == pytest.approx(value, abs=1e-11)


def test_a_site_that_passes_on_what_it_hears_in_a_frame_is_estimated_and_says_so() -> None:
    clocks = {"haptic": 3 * MS, "network": 2 * MS, "comp": Fraction(0), "comm": Fraction(0)}
    found = analyze(linked(paper(peers=300, **clocks), "ring"))
    few = analyze(linked(paper(peers=200, **clocks), "ring"))
    assert "all others are estimated to die out faster" in found.notes[0]
    assert found.spectral_radius > few.spectral_radius
