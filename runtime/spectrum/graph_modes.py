"""The eigenvalues of a graph's weight matrix W: in closed form, or from floats with error bounds.

Takes: a `Graph` of a link and the number of its peers.
Gives: `GraphMode`, `Surd`, `graph_modes`, `ring_mode`.
Guarantees: an eigenvalue that equal row sums make exact, or that is a simple fraction, is exact, with its
multiplicity proven; any other comes with a bound on its error.
Does not: use the values sent over the graph, or close a loop (see `graph_loops`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Graph
from apc.compiler.weights import arcs, exact_weight, sum_weights
from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF
from apc.spectrum.null_space import null_space

Integers = NDArray[np.int64]

# Backward error of LAPACK's eigenvalue solvers in units of n·UNIT·‖W‖_F: 'a modest constant' (LAPACK Users'
# Guide, 3rd ed., section 4.7).
EIGEN_ROUNDINGS = 10

# The largest condition of eigenvectors: beyond it the matrix may lack a full set of eigenvectors.
WORST_CONDITION = 1e6

# Beyond this number of peers, the multiplicity of a repeated row sum as an eigenvalue is not proved in exact
# rationals.
MOST_EXACT = 300

# The largest denominator of a fraction, such as −1 of two peers or −1/2 of three, that is tested as an exact
# eigenvalue.
MOST_DENOMINATOR = 12


@dataclass(frozen=True, slots=True)
class Surd:
    """A real number known in closed form: `scale` · cos(2π · `turn`) · √`square`."""

    scale: Fraction
    turn: Fraction = Fraction(0)
    square: int = 1


@dataclass(frozen=True, slots=True)
class GraphMode:
    """An eigenvalue of W with its `multiplicity`; with a positive imaginary part it represents a pair.

    `weight_error` bounds its error; `common` states that all peers have equal amplitude and phase in it.
    `surd` is its exact value, where `weight_error` is not zero and there is a closed form.
    """

    real: Fraction
    imaginary: Fraction
    multiplicity: int
    weight_error: float
    common: bool
    surd: Surd | None = None

    @property
    def value(self) -> complex:
        """The eigenvalue."""
        return complex(self.real, self.imaginary)


def graph_modes(graph: Graph, peers: int, *, mean: bool) -> tuple[GraphMode, ...] | None:
    """Return the eigenvalues of a graph's W, None if W may lack a full set of eigenvectors.

    Parameters
    ----------
    graph
        The graph.
    peers
        The number N of peers.
    mean
        Whether W's rows are divided by their sums.
    """
    n = peers
    if graph.shape == "ring" and n > 2:
        return tuple(ring_mode(k, n, mean=mean) for k in range(n // 2 + 1))
    if graph.shape == "star" and n > 2:
        # The centre and the others, in phase or opposite: ±1 of the mean, ±√(n−1) of the sum; then
        # differences of the others.
        root = math.isqrt(n - 1)
        exact = mean or root**2 == n - 1
        largest = Fraction(1) if mean else Fraction(root) if exact else Fraction(math.sqrt(n - 1))
        weight_error = 0.0 if exact else float(largest) * UNIT_ROUNDOFF
        return (
            GraphMode(largest, Fraction(0), 1, weight_error, mean, Surd(Fraction(1), square=n - 1)),
            GraphMode(-largest, Fraction(0), 1, weight_error, False, Surd(Fraction(-1), square=n - 1)),
            GraphMode(Fraction(0), Fraction(0), n - 2, 0.0, False),
        )
    return _numeric_modes(graph, n, mean=mean)


def ring_mode(k: int, n: int, *, mean: bool) -> GraphMode:
    """Return eigenvalue k of a ring of n peers, 0 ≤ k ≤ n/2: 2 cos(2πk/n) of the sum, half of this of
    the mean.
    """
    scale = Fraction(1, 2) if mean else Fraction(1)
    multiplicity = 1 if 2 * k in (0, n) else 2
    value = 2 * scale * _cosine(k, n)
    return GraphMode(
        value, Fraction(0), multiplicity, _cosine_error(k, n), k == 0, Surd(2 * scale, Fraction(k, n))
    )


def _cosine(k: int, n: int) -> Fraction:
    """Return cos(2πk/n), exactly if it is rational (Niven: 0, ±1/2 and ±1 only)."""
    turn = Fraction(k, n)
    rational_cosines = {
        Fraction(0): Fraction(1),
        Fraction(1, 6): Fraction(1, 2),
        Fraction(1, 4): Fraction(0),
        Fraction(1, 3): Fraction(-1, 2),
        Fraction(1, 2): Fraction(-1),
    }
    return rational_cosines[turn] if turn in rational_cosines else Fraction(math.cos(2 * math.pi * k / n))


def _cosine_error(k: int, n: int) -> float:
    """Return an error bound of 2 cos(2πk/n) in floats: the rounding of the argument, up to π, and of the
    cosine.
    """
    return 0.0 if Fraction(k, n).denominator in (1, 2, 3, 4, 6) else 2 * (4 * math.pi + 2) * UNIT_ROUNDOFF


def _numeric_modes(graph: Graph, n: int, *, mean: bool) -> tuple[GraphMode, ...] | None:
    """Return the eigenvalues of W from floats, with eigenvalues merged that are equal within their errors."""
    pairs, weights = arcs(graph, n)
    weight_matrix = np.zeros((n, n))
    np.add.at(weight_matrix, (pairs[:, 1], pairs[:, 0]), weights)
    sums = sum_weights(pairs[:, 1], weights, n).astype(np.float64)  # cancellation loses no digits
    matrix = weight_matrix / sums[:, None] if mean else weight_matrix
    relative_error = EIGEN_ROUNDINGS * n * UNIT_ROUNDOFF
    if np.array_equal(weight_matrix, weight_matrix.T) and (not mean or np.all(sums > 0)):
        # D⁻¹S is similar to D^(−1/2) S D^(−1/2): real, with a full set of eigenvectors.
        root = np.sqrt(sums) if mean else np.ones(n)
        symmetric = weight_matrix / root[:, None] / root
        values = np.linalg.eigvalsh((symmetric + symmetric.T) / 2).astype(np.complex128)
        weight_error = relative_error * float(np.linalg.norm(symmetric))
    else:
        values, vectors = np.linalg.eig(matrix)
        condition = float(np.linalg.cond(vectors))
        if not condition <= WORST_CONDITION:
            return None
        # Bauer and Fike: an eigenvalue moves no further than the condition times the matrix.
        weight_error = relative_error * condition * float(np.linalg.norm(matrix))
    exact_sum = _row_sum(graph, n, mean=mean)
    modes = []
    for cluster in _clusters(values, weight_error):
        centre = complex(np.mean(values[cluster]))
        spread = weight_error + float(np.abs(values[cluster] - centre).max())
        if exact_sum is not None and abs(centre - float(exact_sum)) <= spread:
            is_exact = _is_exact(graph, n, exact_sum, len(cluster), mean=mean)
            modes.append(
                GraphMode(exact_sum, Fraction(0), len(cluster), 0.0 if is_exact else spread, common=True)
            )
        elif (fraction := _simple_fraction(centre, spread)) is not None and _is_exact(
            graph, n, fraction, len(cluster), mean=mean
        ):
            modes.append(GraphMode(fraction, Fraction(0), len(cluster), 0.0, common=False))
        elif abs(centre.imag) <= spread:
            modes.append(
                GraphMode(Fraction(centre.real), Fraction(0), len(cluster), spread + abs(centre.imag), False)
            )
        elif centre.imag > 0:  # its conjugate has a cluster of its own
            modes.append(GraphMode(Fraction(centre.real), Fraction(centre.imag), len(cluster), spread, False))
    return tuple(sorted(modes, key=lambda mode: (not mode.common, -mode.real, mode.imaginary)))


def _simple_fraction(value: complex, error_bound: float) -> Fraction | None:
    """Return the simple fraction within an eigenvalue's error, None if there is none."""
    number = Fraction(value.real).limit_denominator(MOST_DENOMINATOR)
    return number if abs(value - float(number)) <= error_bound else None


def _clusters(values: NDArray[np.complex128], weight_error: float) -> list[Integers]:
    """Return the clusters of indistinguishable eigenvalues, by their indices."""
    cluster = np.arange(len(values))
    for index in range(len(values)):
        near = np.unique(cluster[np.abs(values - values[index]) <= 2 * weight_error])
        cluster[np.isin(cluster, near)] = near[0]
    return [np.flatnonzero(cluster == label) for label in np.unique(cluster)]


def _row_sum(graph: Graph, n: int, *, mean: bool) -> Fraction | None:
    """Return the exact sum of every row of W, None if the sums differ."""
    if mean:
        return Fraction(1)
    pairs, weights = arcs(graph, n)
    sums = sum_weights(pairs[:, 1], weights, n)
    return sums[0] if np.all(sums == sums[0]) else None


def _is_exact(graph: Graph, n: int, value: Fraction, multiplicity: int, *, mean: bool) -> bool:
    """Return whether a rational is proved to be an eigenvalue of W with exactly this multiplicity.

    Parameters
    ----------
    graph, n, mean
        The graph of n peers; `mean` states that rows are divided by their sums.
    value, multiplicity
        The eigenvalue, and the dimension of its null space.
    """
    pairs, weights = arcs(graph, n)
    rows: dict[tuple[int, int], Fraction] = {}
    for (sender, receiver), weight in zip(pairs.tolist(), weights.tolist(), strict=True):
        rows[receiver, sender] = rows.get((receiver, sender), Fraction(0)) + exact_weight(weight)
    for peer in range(n):
        rows.setdefault((peer, peer), Fraction(0))
    if mean:  # D (D⁻¹S − value) has the same null space
        degree = [Fraction(0)] * n
        for (receiver, _), weight in rows.items():
            degree[receiver] += weight
        for peer in range(n):
            rows[peer, peer] -= value * degree[peer]
    else:
        for peer in range(n):
            rows[peer, peer] -= value
    if n > MOST_EXACT and multiplicity > 1:
        return False
    matrix = np.zeros((n, n), dtype=object)
    for index, entry in rows.items():
        matrix[index] = entry
    return len(null_space(matrix)) == multiplicity
