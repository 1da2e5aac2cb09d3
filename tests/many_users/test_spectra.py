"""Many users as few small systems, by groups, graphs, columns: against all of them stepped by hand."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import apc
from apc.analysis.analysis import Analysis
from apc.compiler.errors import ApcError
from apc.spectrum.eigenpairs import (
    components,
    driving_parts,
    eigenpairs,
    eigenvalues,
    inverses,
    largest_magnitudes,
    pairs_of_eigenvalues,
)
from tests.bruteforce import TopologySource, frame_matrices, frame_matrix
from tests.pairing import apart, arcs_of
from tests.topologies import AVERAGE, ROOT, compiled, replaced
from tests.truths import text_of

MS = Fraction(1, 1000)
GAINS: dict[str, Any] = {"kt": 800.0, "bt": 2.0, "kc": 1500.0, "bc": 2.0}
SOFT = {**GAINS, "kt": 200.0}


def weights(name: str, peers: int) -> dict[tuple[int, int], float]:
    return {(i, j): weight for i, j, weight in arcs_of(name, peers)}


def masses(*values: float) -> tuple[dict[str, float], ...]:
    return tuple({"device": value} for value in values)


def pairs(first: dict[tuple[int, int], int]) -> dict[tuple[int, int], Fraction]:
    """Return delays of pairs of peers of four, of which the first two are alike and the others are."""
    return {
        (i, j): first[i // 2, j // 2] * MS for i in range(4) for j in range(4) if (i // 2, j // 2) in first
    }


def on(name: str, operator: str) -> TopologySource:
    """Return four equal peers on a graph; a sum is over the differences to those who are heard."""
    springs = {(i, j): 800.0 for i in range(4) for j in range(4)} if operator == "sum" else {}
    return TopologySource(operator, 4, weights=weights(name, 4), pairs=springs, **GAINS)


def listed(found: Analysis) -> NDArray[np.complex128]:
    """Return all eigenvalues that an analysis lists, those that it leaves out, too."""
    values = [np.repeat(mode.eigenvalue, mode.multiplicity) for mode in found.modes]
    return np.concatenate([*values, np.ones(found.rigid_modes)])


# Topologies, how they are taken apart, and how far eigenvalues may be off: a defective one scatters by the
# root of its rounding, four peers deep.
TOPOLOGIES: dict[str, tuple[TopologySource, str, float]] = {
    **{f"mean of {n}": (TopologySource(peers=n, **GAINS), "modes", 1e-11) for n in (2, 3, 12)},
    "sum of 8": (TopologySource("sum", 8, **{**GAINS, "kt": 100.0, "bt": 0.25}), "modes", 1e-11),
    **{
        f"{operator} on {name}": (on(name, operator), "modes", 1e-10)
        for name, operator in (
            *(("ring", "sum"), ("star", "mean"), ("path", "mean"), ("two pairs", "mean"), ("cycle", "sum")),
            ("apart", "mean"),
        )
    },
    # Nilpotent: no full set of eigenvectors.
    "one way": (on("one way", "sum"), "dense", 2e-3),
    "all different": (TopologySource(users=masses(0.1, 0.2, 0.15), **GAINS), "modes", 1e-11),
    "different on a ring": (
        TopologySource(peers=4, weights=weights("ring", 4), users=masses(0.1, 0.2, 0.15, 0.3), **GAINS),
        *("dense", 1e-11),
    ),
    # Who hear the same two may change places.
    "two alike on a ring": (
        TopologySource(peers=4, weights=weights("ring", 4), users=masses(0.1, 0.2, 0.1, 0.3), **GAINS),
        *("modes", 1e-11),
    ),
    "two kinds of five": (
        TopologySource(peers=5, users=masses(0.1, 0.2, 0.1, 0.1, 0.2), **GAINS),
        *("modes", 1e-11),
    ),
    "a star of which the middle differs": (
        TopologySource(peers=6, weights=weights("star", 6), users=masses(0.25, *[0.1] * 5), **SOFT),
        *("modes", 1e-9),
    ),
    "forks at both ends of a path": (
        TopologySource(
            peers=6,
            weights={p: 1.0 for a, b in ((0, 2), (1, 2), (2, 3), (3, 4), (3, 5)) for p in ((a, b), (b, a))},
            **SOFT,
        ),
        *("modes", 1e-9),
    ),
    "pairs of delays": (TopologySource(peers=4, late=pairs({(0, 1): 12, (1, 0): 3}), **SOFT), "modes", 1e-11),
    "pairs of delays in a sum": (
        TopologySource("sum", 4, late=pairs({(0, 0): 0, (0, 1): 4}), **{**SOFT, "kt": 60.0}),
        *("modes", 1e-11),
    ),
    "pairs of delays on a ring": (
        TopologySource(
            peers=4,
            late={
                pair: delay
                for pair, delay in pairs({(0, 1): 12, (1, 0): 3}).items()
                if pair in weights("ring", 4)
            },
            weights=weights("ring", 4),
            **SOFT,
        ),
        *("dense", 1e-11),
    ),
}


@pytest.mark.few(10)
@pytest.mark.parametrize("name", TOPOLOGIES)
def test_the_modes_are_the_whole_spectrum_of_all_peers(name: str) -> None:
    topology, method, off = TOPOLOGIES[name]
    expected = np.linalg.eigvals(np.array(frame_matrix(topology)))
    found = apc.analyze(compiled(text_of(topology)))
    assert found.method == method
    assert apart(listed(found), expected) < off
    assert apart(listed(apc.analyze(compiled(text_of(topology)), method="dense")), expected) < max(off, 1e-10)


def test_groups_that_differ_in_nothing_that_moves_are_one() -> None:
    text = replaced(
        AVERAGE, ("  user: {count: 3}", "  left: {count: 2, set: {device.x: 1 mm}}\n  right: {count: 1}")
    )
    one, other = apc.analyze(compiled(text)), apc.analyze(compiled(AVERAGE))
    assert {mode.family for mode in one.modes} == {"common", "difference"}
    assert [mode.eigenvalue for mode in one.modes] == [mode.eigenvalue for mode in other.modes]
    column = replaced(AVERAGE, ("{count: 3}", "{set: {contact.damping: [0 N*s/m, -0 N*s/m, 1 N*s/m]}}"))
    assert {mode.multiplicity for mode in apc.analyze(compiled(column)).modes} == {1}
    assert len({mode.family for mode in apc.analyze(compiled(column)).modes}) == 2


# ---- very many ----


def radius_by_hand(received: NDArray[np.float64], **values: Any) -> float:
    """Return the largest eigenvalue but that of the common shift, of peers who hear so many times themselves.

    In a pair each hears the other: what one's own state and what the other's makes of one's next state.
    """
    whole = frame_matrices(TopologySource(peers=2, **values), 1)[0]
    n = len(whole) // 2
    own, other = whole[:n, :n], whole[:n, n:]
    sizes = np.abs(np.linalg.eigvals(own + received[:, None, None] * other))
    return float(np.sort(sizes[sizes < 1 - 1e-12] if sizes.max() < 1 + 1e-9 else sizes.ravel())[-1])


def on_graph(peers: int, graph: str, **values: Any) -> str:
    text = text_of(TopologySource(peers=peers, **values))
    return replaced(text, ("clock: network, delay", f"graph: {graph}, clock: network, delay"))


RINGS: list[dict[str, Any]] = [
    {},
    {"comp": Fraction(0), "comm": Fraction(0), "kt": 2000.0},
    {"kc": 2400.0},
    {"kc": 1500.0, "kt": 5000.0},
]


@pytest.mark.few(4)
@pytest.mark.parametrize("values", RINGS, ids=str)
@pytest.mark.parametrize(("peers", "graph"), [(301, "ring"), (1_000_000, "complete")])
def test_very_many_alike_have_the_radius_of_all_their_modes(
    peers: int, graph: str, values: dict[str, Any]
) -> None:
    """Each hears the mean of its neighbours: cos(2πk/N) of itself; of all others: 1, or −1/(N − 1)."""
    angles = 2 * np.pi * np.arange(peers // 2 + 1 if graph == "ring" else 1) / peers
    received = np.cos(angles) if graph == "ring" else np.array([1.0, -1 / (peers - 1)])
    found = apc.analyze(compiled(on_graph(peers, graph, **values)))
    assert (
        abs(found.spectral_radius - radius_by_hand(received, **values)) <= 1e-11 + found.spectral_radius_error
    )
    assert found.rigid_modes == 1 and found.stable == (found.spectral_radius < 1)
    assert found.spectral_radius_error < 1e-11


def different(peers: int, graph: str = "complete", **values: Any) -> str:
    """Return peers whose masses and contacts all differ."""
    random = np.random.default_rng(0)
    gains = {"kt": 400.0, "bt": 1.0, "bc": 1.0} | values
    if gains.get("operator") == "sum":
        gains |= {"kt": gains["kt"] / peers, "bt": gains["bt"] / peers}
    own = {
        "device.mass": [f"{0.1 * (1 + 0.3 * one):.6f} kg" for one in random.random(peers)],
        "contact.stiffness": [f"{1000 * (1 + 0.3 * one):.3f} N/m" for one in random.random(peers)],
    }
    listed = ", ".join(f"{name}: [{', '.join(rows)}]" for name, rows in own.items())
    return replaced(on_graph(peers, graph, **gains), (f"{{count: {peers}}}", f"{{set: {{{listed}}}}}"))


LARGE = [
    different(12),
    different(5, operator="sum"),
    different(12, kt=6000.0),
    different(5, comp=Fraction(0), comm=Fraction(0)),
    different(5, comp=MS * 5 / 2, comm=4 * MS),
    different(2, haptic=2 * MS, network=3 * MS),
    different(5, comm=30 * MS),
]


@pytest.mark.parametrize("text", LARGE)
def test_determinants_of_many_who_differ_have_the_modes_of_the_whole_matrix(text: str) -> None:
    found, whole = (
        apc.analyze(compiled(text), method="determinant"),
        apc.analyze(compiled(text), method="dense"),
    )
    assert (found.verdict, found.rigid_modes) == (whole.verdict, whole.rigid_modes)
    off = abs(found.spectral_radius - whole.spectral_radius)
    assert off <= found.spectral_radius_error + whole.spectral_radius_error < 1e-7
    for mode in found.modes:
        same = min(whole.modes, key=lambda one: abs(one.eigenvalue - mode.eigenvalue))
        assert abs(same.eigenvalue - mode.eigenvalue) <= mode.error + same.error
        assert mode.frequency_hz == pytest.approx(same.frequency_hz, abs=1e-8)
        assert mode.damping_ratio == pytest.approx(same.damping_ratio, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "method"),
    [
        (text_of(TopologySource(peers=1_000_000)), "modes"),
        (different(3), "modes"),
        (different(60), "determinant"),
        (on_graph(1000, "ring"), "modes"),
        (text_of(TopologySource(comm=8000 * MS)), "determinant"),
        (text_of(TopologySource(comm=80 * MS)), "modes"),
    ],
    ids=["a million", "three", "sixty", "a ring", "8 s late", "80 ms late"],
)
def test_the_method_is_chosen_by_what_differs(text: str, method: str) -> None:
    assert apc.analyze(compiled(text)).method == method


@pytest.mark.parametrize(
    ("text", "method", "message"),
    [
        (
            text_of(TopologySource(peers=200)),
            "dense",
            "E804 200 peers form one system of 1,600 states; the limit",
        ),
        (
            different(3, "ring"),
            "modes",
            "E850 method modes does not apply to this topology: all peers as one system",
        ),
        (
            different(60, "ring"),
            "determinant",
            "E850 method determinant .* not completely connected over lan",
        ),
    ],
)
def test_a_method_that_cannot_serve_is_refused(text: str, method: str, message: str) -> None:
    with pytest.raises(ApcError, match=message):
        apc.analyze(compiled(text), method=method)  # type: ignore[arg-type] # a method


def test_eigenvalues_get_the_vectors_of_the_nearest_ones_each_once() -> None:
    """A triangular matrix with eigenvalues that are equal or nearly so, in another order and rounded."""
    matrix = np.diag([0.0, 0.5, 0.0, 0.9, 0.0, 0.5 + 1e-9]) + np.diag([0, 0, 0.3, 0, 0.2], 1)
    values = np.array([0.9 + 1e-15, 0.0, 0.5 + 1.1e-9, 1e-17, -1e-17, 0.5 - 1e-10], dtype=np.complex128)
    pairs = pairs_of_eigenvalues(matrix, values)
    assert np.abs(matrix @ pairs.right - pairs.right * values).max() < 1e-9
    assert np.abs(pairs.left @ matrix - values[:, None] * pairs.left).max() < 1e-9
    assert len(np.unique(pairs.right.round(12), axis=1).T) == 6


@pytest.mark.parametrize("count", [0, 1, 2, 9, 70])
def test_components_are_states_that_reach_one_another(count: int) -> None:
    random = np.random.default_rng(count)
    for share in (0.0, 0.5 / max(count, 1), 1.5 / max(count, 1), 1.0):
        driven = random.random((count, count)) < share
        paths = np.eye(count) + driven
        for _ in range(7):  # paths of up to 2^7 steps
            paths = np.minimum(paths @ paths, 1.0)
        mutual = (paths > 0) & (paths.T > 0)
        expected = {tuple(np.flatnonzero(row).tolist()) for row in mutual}
        assert [tuple(part.tolist()) for part in components(driven)] == sorted(expected)


def test_a_matrix_of_no_states_has_no_eigenvalues() -> None:
    """A mass that coasts alone leaves a block of no states once its translation is split off."""
    empty, batch = np.zeros((0, 0)), np.zeros((2, 0, 0))
    assert eigenpairs(empty).values.size == pairs_of_eigenvalues(empty, np.zeros(0, complex)).values.size == 0
    assert eigenvalues(batch, batch)[0].shape == (2, 0)
    assert largest_magnitudes(batch).tolist() == [0, 0]
    assert inverses(empty).size == 0
    assert components(empty.astype(bool)) == driving_parts(empty.astype(bool)) == []


def test_a_determinant_that_overflows_is_refused_and_the_matrices_decide() -> None:
    """A frame of the loop of 40 frames of delay grows by many decades at points beside the circle."""
    values = {
        "contact.damping": "0.3323 N*s/m",
        "coordination.stiffness": "10290 N/m",
        "coordination.damping": "0.712 N*s/m",
        "contact.delay": "320 ms",
        "coordination.delay": "16 ms",
    }
    model = apc.set_parameters(apc.compile(ROOT / "models" / "topologies" / "experiment-mesh.yaml"), values)
    with pytest.raises(ApcError, match="E850 method determinant does not apply"):
        apc.analyze(model, method="determinant")
    assert apc.analyze(model).stable is False
