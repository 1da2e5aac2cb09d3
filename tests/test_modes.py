"""Claims about `apc.eigen.modes`."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from apc.analysis.analysis import analyze, lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.eigen.closing import Coupling, close_loop
from apc.eigen.modes import complete_degrees, couple, dense, dense_loop, split, split_exchangeable
from apc.frame.schedule import Way
from tests.bruteforce import Scene, frame_matrix
from tests.sites import MS, columned, edged, grouped, linked, paper


def _coupled(system: Any, weight: int = 1) -> Coupling:
    groups, exchange = lifted_groups(system)
    degrees = complete_degrees(groups, exchange)
    return couple(groups, exchange, lambda way, g, h: Fraction(weight * groups[h].count - (g == h)), degrees)


def _pair(operator: str, **values: Any) -> Any:
    return grouped(paper(operator, **values), ("left", 2, {"device.mass": 0.2}), ("right", 3, {}))


def test_a_sum_counts_the_others_and_a_mean_divides_by_them() -> None:
    [total] = _coupled(_pair("sum")).values()
    assert total == ((1, 3), (2, 2))
    [mean] = _coupled(_pair("mean")).values()
    assert mean == ((Fraction(1, 4), Fraction(3, 4)), (Fraction(2, 4), Fraction(2, 4)))


def test_senders_of_another_delay_are_on_another_way() -> None:
    found = _coupled(linked(_pair("sum"), delays={("left", "right"): 16 * MS}))
    usual, late = (found[Way("sum", "lan", name)] for name in ("lan.delay", "lan.delay left right"))
    assert usual == ((1, 3), (0, 2))
    assert late == ((0, 0), (2, 0))


def test_of_a_maximum_only_the_one_it_is_taken_from_counts_and_once() -> None:
    system = columned(edged(paper(peers=3, kt=100.0), "max"), cube__x__start=[0.0, 0.01, 0.03])
    position = next(rows for way, rows in _coupled(system).items() if way.channel == "coordination.x")
    # All look at the first but the first, which looks at the second: there its distance is largest.
    assert position == ((0, -100, 0), (-100, 0, 0), (-100, 0, 0))


def test_a_mean_of_weights_that_add_up_to_nothing_is_refused() -> None:
    groups, exchange = lifted_groups(paper())
    with pytest.raises(ApcError, match="E802"):
        couple(groups, exchange, lambda way, g, h: Fraction(1), {("lan", 0): Fraction(0)})


# A path of four with a fork at either end: 0 and 1 are twins, and 4 and 5.
FORKED = [(0, 2), (1, 2), (2, 3), (3, 4), (3, 5)]
ARCS = [(a, b, 1.0) for pair in FORKED for a, b in (pair, pair[::-1])]


@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize(
    ("graph", "sizes"), [("star", [2, 1]), (ARCS, [4, 1, 1]), ("ring", [6]), ("complete", [2, 1])]
)
def test_the_loops_have_together_the_spectrum_of_the_whole(
    operator: str, graph: Any, sizes: list[int]
) -> None:
    first = ("first", 1, {"device.mass": 0.25}) if graph in ("star", "complete") else ("first", 1, {})
    base = grouped(paper(operator, kt=300.0, bt=1.0, kc=800.0), first, ("others", 5, {}))
    groups, exchange = lifted_groups(linked(base, graph))
    whole = dense_loop(groups, exchange)
    loops = split_exchangeable(whole, exchange)
    assert [len(loop.sites) for loop in loops] == sizes
    together = [
        np.linalg.eigvals(close_loop(loop).matrix) for loop in loops for _ in range(loop.multiplicity)
    ]
    expected, found = np.linalg.eigvals(close_loop(whole).matrix), np.concatenate(together)
    assert len(found) == len(expected)
    for value in expected[np.abs(expected) > 0.1]:
        near = np.abs(found - value) < 1e-9
        assert near.sum() == (np.abs(expected - value) < 1e-9).sum()


def test_a_star_of_many_equal_peers_is_two_small_determinants() -> None:
    base = grouped(paper(kt=300.0, bt=1.0, kc=800.0), ("first", 1, {"device.mass": 0.25}), ("others", 19, {}))
    system = linked(base, "star")
    found, whole = analyze(system, method="determinant"), analyze(system, method="dense")
    assert (found.verdict, found.rigid_modes) == (whole.verdict, whole.rigid_modes)
    apart = abs(found.spectral_radius - whole.spectral_radius)
    assert apart <= found.spectral_radius_error + whole.spectral_radius_error
    assert found.spectral_radius_error < 1e-7


# Queues that run empty make defective eigenvalues at zero, which rounding scatters by its n-th root: all that
# is smaller than this per frame is compared by number only.
SMALL = 1e-2


def _split(system: CompiledSystem) -> np.ndarray:
    """Return all eigenvalues of the split system, each as often as it counts."""
    systems = split(*lifted_groups(system)).systems
    return np.concatenate([np.repeat(np.linalg.eigvals(one.matrix), one.multiplicity) for one in systems])


def _apart(one: np.ndarray, other: np.ndarray, *, same_size: bool = True) -> float:
    """Return the largest distance when two spectra are paired, nearest first; small ones are counted only."""
    if same_size:
        assert len(one) == len(other)
    mine, yours = one[np.abs(one) > SMALL], list(other[np.abs(other) > SMALL])
    assert len(mine) == len(yours)
    worst = 0.0
    for value in mine:
        nearest = min(range(len(yours)), key=lambda place: abs(yours[place] - value))
        worst = max(worst, abs(yours.pop(nearest) - value))
    return worst


GAINS = {"kt": 800.0, "bt": 2.0, "kc": 1500.0, "bc": 2.0}


@pytest.mark.parametrize("peers", range(2, 31))
def test_common_and_difference_modes_are_the_whole_spectrum(peers: int) -> None:
    operator = "mean" if peers % 2 else "sum"
    gains = GAINS if operator == "mean" else {**GAINS, "kt": 800.0 / peers, "bt": 2.0 / peers}
    comp = MS if peers <= 8 else Fraction(0)
    system = paper(operator, peers=peers, comp=comp, **gains)
    whole = np.linalg.eigvals(dense(*lifted_groups(system)).matrix)
    assert _apart(_split(system), whole) < 1e-12


def test_groups_are_the_whole_spectrum_too() -> None:
    system = grouped(
        paper("sum", kt=300.0, bt=1.0, kc=1500.0, bc=2.0, comm=11 * MS),
        ("left", 2, {"device.mass": 0.15}),
        ("right", 3, {"contact.stiffness": 900.0}),
        ("alone", 1, {"cube.damping": 7.0}),
    )
    groups, exchange = lifted_groups(system)
    assert [(one.name, one.multiplicity) for one in split(groups, exchange).systems] == [
        ("common", 1),
        ("difference left", 1),
        ("difference right", 2),
    ]
    assert split(groups, exchange).systems[0].names[:2] == ("left.device.x", "left.device.v")
    assert _apart(_split(system), np.linalg.eigvals(dense(groups, exchange).matrix)) < 1e-12


def test_groups_that_differ_in_nothing_that_moves_are_one() -> None:
    system = grouped(paper(), ("left", 2, {"device.x.start": 0.1}), ("right", 1, {"hand.force": 2.0}))
    [group], exchange = lifted_groups(system)
    assert (group.name, group.count) == ("left+right", 3)
    assert [one.name for one in split([group], exchange).systems] == ["common", "difference"]


CONVENTIONS: list[dict[str, object]] = [
    {},
    {"operator": "sum"},
    {"comm": 4 * MS},
    {"comm": 11 * MS},
    {"comp": MS * 2 / 5},
    {"comp": MS * 5 / 2},
    {"comp": 3 * MS, "comm": 24 * MS},
    {"comp": Fraction(0), "comm": Fraction(0)},
    {"comp": Fraction(0), "comm": Fraction(0), "haptic_phase": MS / 2},
    {"haptic_phase": MS * 3 / 10, "network_phase": MS * 5 / 2, "comm": 5 * MS},
    {"haptic": 2 * MS, "network": 5 * MS, "comm": 7 * MS},
    {"haptic": 2 * MS, "network": 3 * MS},
    {"haptic": 3 * MS, "network": 2 * MS, "comm": Fraction(0), "comp": Fraction(0)},
    {"haptic": 2 * MS, "network": MS, "comm": MS / 2},
    {"haptic": MS, "network": MS, "comm": Fraction(0)},
    {"own_delay": True},
    {"own_delay": True, "operator": "sum", "comm": Fraction(0)},
]


@pytest.mark.parametrize("values", CONVENTIONS)
def test_peers_stepped_one_by_one_have_the_same_spectrum(values: dict[str, Any]) -> None:
    system = paper(**GAINS, **values)
    whole = np.linalg.eigvals(np.array(frame_matrix(Scene(**GAINS, **values))))
    assert _apart(_split(system), whole, same_size=False) < 1e-12


def test_different_peers_stepped_one_by_one_have_the_same_spectrum() -> None:
    system = grouped(
        paper(comm=5 * MS, **GAINS), ("light", 2, {}), ("heavy", 1, {"device.mass": 0.3, "cube.mass": 0.4})
    )
    scene = Scene(comm=5 * MS, **GAINS, users=({}, {}, {"device": 0.3, "cube": 0.4}))
    whole = np.linalg.eigvals(np.array(frame_matrix(scene)))
    assert _apart(_split(system), whole, same_size=False) < 1e-12


def _brute(scene: Scene) -> np.ndarray:
    return np.linalg.eigvals(np.array(frame_matrix(scene)))


def _arcs(name: str, peers: int) -> list[tuple[int, int, float]]:
    """Return graphs as (sender, receiver, weight): by hand what `ring` and `star` mean, and others."""
    both = {
        "ring": [(i, (i + 1) % peers, 1.0) for i in range(peers)],
        "star": [(0, i, 1.0) for i in range(1, peers)],
        "path": [(i, i + 1, 0.5 + i) for i in range(peers - 1)],
        "two pairs": [(0, 1, 1.0), (2, 3, 1.0)],
    }
    if name in both:
        return sorted({arc for i, j, w in both[name] for arc in ((i, j, w), (j, i, w))})
    return {
        "cycle": [(i, (i + 1) % peers, 0.7) for i in range(peers)],
        "one way": [(i, i + 1, 1.0) for i in range(peers - 1)],
        "apart": [(0, 1, 2.0), (1, 0, 2.0), (0, 2, -0.5), (3, 2, 1.5), (2, 3, 1.0)],
    }[name]


@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize("peers", [2, 3, 4, 5])
@pytest.mark.parametrize("shape", ["ring", "star"])
def test_equal_peers_on_a_ring_or_star_are_one_small_system_an_eigenvalue(
    shape: str, peers: int, operator: str
) -> None:
    gains = {**GAINS, "kt": 300.0}
    system = linked(paper(operator, peers=peers, **gains), shape)
    weights = {(i, j): weight for i, j, weight in _arcs(shape, peers)}
    found = split(*lifted_groups(system))
    assert found.method == "modes"
    assert {len(one.matrix) for one in found.systems} == {8}
    assert sum(one.multiplicity for one in found.systems) == peers
    assert (
        _apart(_split(system), _brute(Scene(operator, peers, weights=weights, **gains)), same_size=False)
        < 1e-11
    )


@pytest.mark.parametrize(
    ("name", "operator", "method"),
    [
        ("path", "mean", "modes"),
        ("path", "sum", "modes"),
        ("two pairs", "mean", "modes"),
        ("cycle", "sum", "modes"),
        ("cycle", "mean", "modes"),
        ("apart", "mean", "modes"),
        ("one way", "sum", "dense"),  # nilpotent: no full set of eigenvectors
    ],
)
def test_equal_peers_on_any_graph_have_the_spectrum_of_all_of_them(
    name: str, operator: str, method: str
) -> None:
    arcs = _arcs(name, 4)
    system = linked(paper(operator, peers=4, **GAINS), arcs)
    scene = Scene(operator, 4, weights={(i, j): weight for i, j, weight in arcs}, **GAINS)
    assert split(*lifted_groups(system)).method == method
    # A defective eigenvalue scatters by the root of its rounding, four peers deep.
    assert _apart(_split(system), _brute(scene), same_size=False) < (1e-10 if method == "modes" else 2e-3)
    whole = np.linalg.eigvals(dense(*lifted_groups(system)).matrix)
    assert _apart(whole, _brute(scene), same_size=False) < (1e-10 if method == "modes" else 2e-3)


def test_a_ring_of_many_peers_costs_half_as_many_systems() -> None:
    found = split(*lifted_groups(linked(paper(peers=40), "ring")))
    assert [one.multiplicity for one in found.systems] == [1, *[2] * 19, 1]
    assert found.systems[0].name == "common"
    assert found.notes == ("21 systems, one an eigenvalue of the graph of lan (ring)",)


@pytest.mark.parametrize("operator", ["mean", "sum"])
def test_different_peers_on_a_graph_are_one_whole_system(operator: str) -> None:
    masses = [0.1, 0.2, 0.15, 0.3]
    system = columned(linked(paper(operator, peers=4, **GAINS), "ring"), device__mass=masses)
    scene = Scene(
        operator,
        4,
        weights={(i, j): weight for i, j, weight in _arcs("ring", 4)},
        users=({}, {"device": 0.2}, {"device": 0.15}, {"device": 0.3}),
        **GAINS,
    )
    found = split(*lifted_groups(system))
    assert (found.method, found.notes) == (
        "dense",
        ("all peers as one system: the peers on lan (ring) differ",),
    )
    assert found.systems[0].names[8] == "user[2].device.x"
    assert _apart(_split(system), _brute(scene), same_size=False) < 1e-12


def test_different_peers_that_can_change_places_move_alike_or_apart() -> None:
    masses = [
        0.1,
        0.2,
        0.1,
        0.3,
    ]  # the first and the third hear the same two
    system = columned(linked(paper(peers=4, **GAINS), "ring"), device__mass=masses)
    users = tuple({"device": mass} for mass in masses)
    scene = Scene("mean", 4, weights={(i, j): w for i, j, w in _arcs("ring", 4)}, users=users, **GAINS)
    found = split(*lifted_groups(system))
    assert [(one.name, one.multiplicity) for one in found.systems] == [
        ("common", 1),
        ("difference user[1,3]", 1),
    ]
    assert _apart(_split(system), _brute(scene), same_size=False) < 1e-12


def test_peers_that_differ_one_by_one_are_grouped_by_what_they_share() -> None:
    system = columned(
        paper(peers=5, **GAINS),
        device__mass=[0.1, 0.2, 0.1, 0.1, 0.2],
        hand__force=[1.0, 2.0, 3.0, 4.0, 5.0],
    )
    groups, exchange = lifted_groups(system)
    assert [(one.name, one.count, one.peers.tolist()) for one in groups] == [
        ("user[1,3,4]", 3, [0, 2, 3]),
        ("user[2,5]", 2, [1, 4]),
    ]
    scene = Scene(peers=5, users=({}, {"device": 0.2}, {}, {}, {"device": 0.2}), **GAINS)
    assert _apart(_split(system), _brute(scene), same_size=False) < 1e-12
    assert [one.multiplicity for one in split(groups, exchange).systems] == [1, 2, 1]


PAIRS = {("left", "right"): 12 * MS, ("right", "left"): 3 * MS, ("right", "right"): 8 * MS}


@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize("graph", ["complete", "ring"])
@pytest.mark.parametrize(
    "delays",
    [PAIRS, {("left", "left"): Fraction(0), ("left", "right"): 4 * MS}, {("left", "right"): 8 * MS}],
)
def test_pairs_of_groups_may_have_delays_of_their_own(
    operator: str, graph: str, delays: dict[tuple[str, str], Fraction]
) -> None:
    base = grouped(paper(operator, **{**GAINS, "kt": 200.0}), ("left", 2, {}), ("right", 2, {}))
    system = linked(base, graph, delays=delays)
    names = ["left", "left", "right", "right"]
    scene = Scene(
        operator,
        4,
        weights={(i, j): w for i, j, w in _arcs("ring", 4)} if graph == "ring" else None,
        late={(i, j): delays.get((names[i], names[j]), 8 * MS) for i in range(4) for j in range(4)},
        **{**GAINS, "kt": 200.0},
    )
    groups, exchange = lifted_groups(system)
    # A delay equal to the usual one is none of its own.
    assert len(groups) == (1 if set(delays.values()) == {8 * MS} else 2)
    assert split(groups, exchange).method == ("dense" if len(groups) == 2 and graph == "ring" else "modes")
    assert _apart(_split(system), _brute(scene), same_size=False) < 1e-11


def _cubic_pairs(starts: list[float], cubic: float) -> dict[tuple[int, int], float]:
    """Return the slopes of K d + c d³ where each pair starts."""
    everyone = range(len(starts))
    return {
        (i, j): GAINS["kt"] + 3 * cubic * (starts[i] - starts[j]) ** 2
        for i in everyone
        for j in everyone
        if i != j
    }


@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize("graph", ["complete", "ring", "star", "apart"])
@pytest.mark.parametrize("starts", [[0.0, 0.0, 0.0, 0.0], [0.01, 0.02, 0.05, 0.02]])
def test_an_edge_function_is_linearized_pair_by_pair(operator: str, graph: str, starts: list[float]) -> None:
    base = edged(paper(operator, peers=4, **GAINS), operator, cubic=2e5)
    arcs = None if graph == "complete" else _arcs(graph, 4)
    system = columned(linked(base, arcs or "complete"), cube__x__start=starts)
    scene = Scene(
        operator,
        4,
        weights={(i, j): weight for i, j, weight in arcs} if arcs else None,
        pairs=_cubic_pairs(starts, 2e5),
        **GAINS,
    )
    assert _apart(_split(system), _brute(scene), same_size=False) < 1e-11
    whole = np.linalg.eigvals(dense(*lifted_groups(system)).matrix)
    assert _apart(whole, _brute(scene), same_size=False) < 1e-11


@pytest.mark.parametrize("peers", [2, 3, 5, 20])
@pytest.mark.parametrize(
    "values",
    [
        {},
        {"comp": Fraction(0), "comm": Fraction(0)},
        {"comm": 11 * MS, "comp": MS * 2 / 5},
        {"own_delay": True},
    ],
)
def test_full_mesh_is_the_average_with_gains_times_the_others(peers: int, values: dict[str, Any]) -> None:
    others = peers - 1
    gains = {"kc": 1500.0, "bc": 2.0}
    mesh = paper("sum", peers=peers, kt=900.0 / others, bt=3.0 / others, **gains, **values)
    mean = paper("mean", peers=peers, kt=900.0, bt=3.0, **gains, **values)
    for one, other in zip(
        split(*lifted_groups(mesh)).systems, split(*lifted_groups(mean)).systems, strict=True
    ):
        size = np.abs(other.matrix).max()
        np.testing.assert_allclose(one.matrix, other.matrix, rtol=1e-12, atol=1e-12 * size)
        assert _apart(np.linalg.eigvals(one.matrix), np.linalg.eigvals(other.matrix)) < 1e-12


def test_two_peers_cannot_tell_a_mean_from_a_sum() -> None:
    for one, other in zip(
        split(*lifted_groups(paper("sum", peers=2))).systems,
        split(*lifted_groups(paper("mean", peers=2))).systems,
        strict=True,
    ):
        np.testing.assert_array_equal(one.matrix, other.matrix)


def test_a_million_peers_are_two_small_systems() -> None:
    systems = split(*lifted_groups(paper(peers=1_000_000))).systems
    assert [(len(one.matrix), one.multiplicity) for one in systems] == [(8, 1), (8, 999_999)]


def test_the_error_bound_covers_the_matrix() -> None:
    """The truth is the same map at 50 digits, entry by entry, of one mode's own matrix."""
    mpmath = pytest.importorskip("mpmath")
    with mpmath.workdps(50):
        rows = frame_matrix(Scene(peers=2, **GAINS, comp=Fraction(0)), number=_number, exp=mpmath.exp)
    system = paper(peers=2, comp=Fraction(0), **GAINS)
    whole = dense(*lifted_groups(system))
    assert [name.split(".", 1)[1] for name in whole.names[:6]] == [
        "device.x",
        "device.v",
        "cube.x",
        "cube.v",
        "coordination.v sent(-8 ms)",
        "coordination.x sent(-8 ms)",
    ]
    size = len(rows) // 2
    packet = 4 + 3 * 1
    own = [0, 1, 2, 3, packet + 1, packet]
    places = [*own, *(size + place for place in own)]
    for i, row in enumerate(places):
        for j, column in enumerate(places):
            assert abs(rows[row][column] - mpmath.mpf(whole.matrix[i, j])) <= whole.error[i, j]


def _number(value: object) -> object:
    import mpmath

    return mpmath.mpf(value)
