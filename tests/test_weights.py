"""Claims about `apc.compiler.weights`, and what an analysis makes of weights."""

from __future__ import annotations

import random
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from apc.analysis.analysis import analyze
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.weights import exact_weight, sum_weights
from apc.eigen.balls import precision
from apc.frame.names import find
from apc.frame.parameters import exact_numbers, resolve
from tests.bench.random_scenes import check, truth
from tests.topologies import MESH, compiled, library, replaced

# A mean whose weights are those of the graph as they stand, for rows that add up to 1.
STOCHASTIC = """\
component: WeightedMean
about: Pulls a copy to what the weights make of the others.
connectors: {object: Flange}
sends: {x: sample(object.x)}
parameters: {stiffness: {unit: N/m}, clock: clock, link: link}
equations:
  - object.f = hold(f)
  - f = stiffness*(sample(object.x) - sum(others.x))
"""


def weighted(edges: str, text: str = MESH) -> str:
    """Return a scene of three users who hear one another over weighted edges or arcs."""
    return replaced(text, ("delay: 8 ms}", f"delay: 8 ms, graph: {{{edges}}}}}"))


def test_a_weight_is_the_decimal_of_the_file() -> None:
    assert exact_weight(0.1) == Fraction(1, 10)
    assert exact_weight(1e-20) == Fraction(1, 10**20)


def test_sums_are_those_of_decimals() -> None:
    sums = sum_weights(np.array([0, 0, 1, 1, 1, 3]), np.array([0.1, 0.2, 0.1, 0.2, -0.3, 0.5]), 4)
    assert [sums.of(peer) for peer in range(4)] == [Fraction(3, 10), 0, 0, Fraction(1, 2)]
    assert sums.floats.tolist() == [0.3, 0.0, 0.0, 0.5]
    assert (sums.alike(1, 3), sums.alike(0, 2)) == (True, False)


def test_sums_that_floats_cannot_tell_apart_are_told_apart() -> None:
    sums = sum_weights(np.array([0, 1, 1]), np.array([0.3, 0.3, 1e-20]), 2)
    assert sums.floats[0] == sums.floats[1]
    assert not sums.alike(0, 2)


@pytest.mark.parametrize("seed", range(6))
def test_peers_that_weigh_one_another_move_together_freely(seed: int) -> None:
    generator = random.Random(seed)
    digits = (1, 2, 4, 9, 15, 17)[seed]
    arcs = [
        f"[{sender}, {receiver}, {generator.uniform(0.05, 1.2):.{digits}f}]"
        for sender in (1, 2, 3)
        for receiver in (1, 2, 3)
        if sender != receiver
    ]
    system = compiled(weighted(f"arcs: [{', '.join(arcs)}]"))
    found = analyze(system, certify=True)
    assert found.verdict == "stable up to a common translation"
    assert found.proof.startswith("proved stable")
    with precision(256):
        assert check(found, *truth(system)) == ""


def test_rows_of_weights_that_add_up_to_one_are_a_mean(tmp_path: Path) -> None:
    text = weighted("arcs: [[1, 2, 0.1], [3, 2, 0.9], [2, 1, 0.3], [3, 1, 0.7], [1, 3, 0.4], [2, 3, 0.6]]")
    text = replaced(text, ("type: FullMesh", "type: WeightedMean"), (", delay: 1 ms, link", ", link"))
    system = compiled(text, library(tmp_path, STOCHASTIC))
    assert analyze(system, certify=True).verdict == "stable up to a common translation"


def test_a_peer_knows_its_count_exactly() -> None:
    system = compiled(weighted("edges: [[1, 2, 0.1], [1, 3, 0.2], [2, 3, 0.3]]"))
    assert _counts(system) == [Fraction(3, 10), Fraction(4, 10), Fraction(5, 10)]


def test_counts_that_doubles_cannot_tell_apart_are_refused() -> None:
    with pytest.raises(ApcError, match=r"E217 .* sums that doubles can't tell apart"):
        compiled(weighted("arcs: [[1, 2, 0.3], [2, 1, 0.3], [3, 1, 1.0e-20], [1, 3]]"))


def test_equal_weights_that_are_no_floats_still_split_into_modes() -> None:
    arcs = "arcs: [[1, 2, 0.1], [2, 3, 0.1], [3, 1, 0.1], [2, 1, 0.2], [3, 2, 0.2], [1, 3, 0.2]]"
    found = analyze(compiled(weighted(arcs)), certify=True)
    assert (found.method, found.verdict) == ("modes", "stable up to a common translation")


def test_a_mean_of_weights_that_cancel_as_decimals_is_refused() -> None:
    arcs = "arcs: [[1, 4, 0.1], [2, 4, 0.2], [3, 4, -0.3], [4, 1], [4, 2], [4, 3]]"
    text = replaced(weighted(arcs), ("FullMesh", "AveragePosition"), ("count: 3", "count: 4"))
    with pytest.raises(ApcError, match="E802"):
        analyze(compiled(text))


def test_many_peers_of_different_weights_keep_their_translation() -> None:
    generator = random.Random(1)
    edges = [
        f"[{peer}, {peer + 1 if peer < 40 else 1}, {generator.randint(1, 9) / 10}]" for peer in range(1, 41)
    ]
    text = replaced(weighted(f"edges: [{', '.join(edges)}]"), ("count: 3", "count: 40"))
    found = analyze(compiled(text))
    assert found.stable
    assert found.rigid_modes == 1


def test_a_count_is_no_parameter_to_set() -> None:
    with pytest.raises(ApcError, match=r"E623 count\(lan\) is how many peers are heard"):
        find(compiled(MESH), "count(lan)")


def _counts(system: CompiledSystem) -> list[Fraction]:
    """Return what each peer hears in all, as the exact analysis takes it."""
    numbers, kind = resolve(system), system.kinds[0]
    place = kind.parameters.index("count(lan)")
    return [exact_numbers(kind, numbers.parameters[0][row])[place] for row in numbers.rows[0]]
