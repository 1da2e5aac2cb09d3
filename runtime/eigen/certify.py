"""Proof in ball arithmetic that a closed system is stable, or that it is not.

Takes: a `ClosedSystem` and its rigid modes.
Gives: `Proof`, `prove`; `schur_cohn`, `root_discs`.
Guarantees: a verdict True or False is proved: every rounding since the sites' exact numbers is inside a ball.
What is too near the circle for the last precision is left open, and so is what lies on it.
Does not: prove what its numbers can't be had exactly for (see `balls.unprovable`).

The characteristic polynomial of the relative coordinates comes in balls; Schur and Cohn's recursion decides
it without an eigenvalue being known. Smith's discs then enclose the eigenvalues.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

from apc.runtime.eigen.balls import Balls, frame_balls, precision, rational_ball, reduced_balls, square
from apc.runtime.eigen.modes import ClosedSystem
from apc.runtime.eigen.rigid import RigidModes, find_rigid_modes, independent_places
from apc.runtime.frame.discretize import UNIT

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Bits tried in turn. A frame of a thousand ticks loses some 150 of them; what lies on the circle is left
# undecided at the last.
PRECISIONS = (256, 512, 1024, 2048, 4096)

# Bits at which weights known as floats only let nothing more be gained: those a long frame loses, and twice
# those of a float.
DOUBTFUL = 512

# More states than this aren't proved: the characteristic polynomial costs n⁴ or so, seconds at this size.
MOST_PROVED = 120

# More states than this aren't enclosed: the eigenvectors in hundreds of bits cost as much.
MOST_ENCLOSED = 60

# A radius known so well needs no more bits: floats can't tell it better.
SHARP = 2.0**-50

# What the characteristic polynomial at 1 is known to before its vanishing is taken for a drift to look for.
SETTLED = 2.0**-40


@dataclass(frozen=True, slots=True)
class Proof:
    """What was proved of one closed system.

    `inside` says whether all eigenvalues but the rigid ones lie inside the unit circle, None if that is left
    open; `bits` with how many bits it was decided, or left open. `free` are the rigid modes, drifts included
    if there are any. Of the matrix in relative coordinates, `values` (m,) are eigenvalues, `right` (m, m)
    their vectors as columns, `left` as rows, and `radii` (m,) those of discs about the values: k discs that
    hang together hold k eigenvalues. `values` is None when these were not looked for or not found.
    """

    inside: bool | None
    bits: int
    free: RigidModes
    values: Complexes | None
    right: Complexes
    left: Complexes
    radii: Floats


def prove(system: ClosedSystem, free: RigidModes, held: Sequence[int]) -> Proof:
    """Prove a closed system stable or unstable, in rising precision.

    Parameters
    ----------
    system
        The closed system, of at most `MOST_PROVED` states.
    free
        Its rigid modes; drifts are looked for only where the eigenvalue 1 remains without them.
    held
        As many places of the state as there are rigid motions, at which these are independent.
    """
    searched = bool(free.drifts) or not free.names
    best, settled = None, 0
    for bits in PRECISIONS:
        with precision(bits):
            matrix = frame_balls(system)
            reduced = square(_relative(matrix, free, held))
            polynomial = reduced.charpoly()
            at_one = polynomial(1)
            if not searched and at_one.contains(0) and float(at_one.rad()) < SETTLED:
                free, searched = find_rigid_modes(system), True
                if free.drifts:
                    held = independent_places(free.basis.T).tolist()
                    reduced = square(_relative(matrix, free, held))
                    polynomial = reduced.charpoly()
            inside = schur_cohn(polynomial.coeffs()) if _stands_still(matrix, free) else None
            settled = settled or (bits if inside is not None else 0)
            if best is not None and inside is None and bits != PRECISIONS[-1]:
                continue
            best = replace(_enclosed(reduced, polynomial, inside, bits, free), bits=settled or bits)
        if inside is not None and (best.values is None or _sharp(best)):
            break
        if any(doubt for way, doubt in system.doubts.items() if way not in system.surds) and bits >= DOUBTFUL:
            break
    assert best is not None
    return best


def _stands_still(matrix: Balls, free: RigidModes) -> bool:
    """Say whether the balls allow that M v = v for the rigid directions.

    These are exact for rational weights; with others, a direction that depends on the weight would be wrong.
    """
    for vector in free.exact[: len(free.names)]:
        exact = [rational_ball(entry) for entry in vector]
        for row, own in zip(matrix, exact, strict=True):
            moved = sum((a * b for a, b in zip(row, exact, strict=True) if not isinstance(b, int) or b), 0)
            if not flint.arb(moved - own).contains(0):
                return False
    return True


def _relative(matrix: Balls, free: RigidModes, held: Sequence[int]) -> Balls:
    rest = [place for place in range(len(matrix)) if place not in set(held)]
    return reduced_balls(matrix, free.exact, held, rest)[0]


def schur_cohn(coefficients: Sequence[Any]) -> bool | None:
    """Say whether all roots of a real polynomial lie inside the unit circle, None if the balls don't tell.

    Parameters
    ----------
    coefficients
        a₀ … a_n as balls, a_n ≠ 0.

    Notes
    -----
    With p*(z) = zⁿ p(1/z) and k = a₀/a_n, the next polynomial is (p − k p*)/z. While |k| < 1 it has as many
    roots outside as p (Rouché: |p| = |p*| on the circle). |k| is the product of all roots' magnitudes: one
    above 1 shows a root outside, and all below 1 leave none, on the circle neither.
    """
    a = list(coefficients)
    while len(a) > 1:
        k = a[0] / a[-1]
        size = abs(k)
        if size > 1:
            return False
        if not size < 1:
            return None
        a = [one - k * other for one, other in zip(a[1:], a[-2::-1], strict=True)]
        a = [one / a[-1] for one in a[:-1]] + [flint.arb(1)]
    return True


def _enclosed(reduced: Any, polynomial: Any, inside: bool | None, bits: int, free: RigidModes) -> Proof:
    """Return the proof with enclosed eigenvalues, if the matrix is not too large and they are found."""
    n = reduced.nrows()
    nothing = np.zeros((0, 0), dtype=np.complex128)
    without = Proof(inside, bits, free, None, nothing, nothing, np.zeros(0))
    if n == 0:
        return Proof(inside, bits, free, np.zeros(0, dtype=np.complex128), nothing, nothing, np.zeros(0))
    if n > MOST_ENCLOSED:
        return without
    try:
        values, left, right = flint.acb_mat(reduced.mid()).eig(left=True, right=True, algorithm="approx")
    except ValueError:  # no convergence
        return without
    centres, radii = root_discs(polynomial, values, bits)
    rights = _vectors(right.transpose().tolist()).T
    return Proof(inside, bits, free, centres, rights, _vectors(left.tolist()), radii)


def _vectors(rows: Sequence[Sequence[Any]]) -> Complexes:
    """Return vectors as rows in floats, each divided by its largest entry."""
    found = np.zeros((len(rows), len(rows)), dtype=np.complex128)
    for line, row in enumerate(rows):
        largest = max(row, key=lambda entry: abs(entry).mid()).mid()
        if not largest.contains(0) and largest.is_finite():
            found[line] = [complex(entry.mid() / largest) for entry in row]
    return found


def root_discs(polynomial: Any, roots: Sequence[Any], bits: int) -> tuple[Complexes, Floats]:
    """Enclose the roots of a polynomial in discs about approximate ones.

    Parameters
    ----------
    polynomial
        A `flint.arb_poly`, monic, degree n.
    roots
        Its roots (n,), approximately, as `flint.acb`.
    bits
        How many bits the roots were computed with.

    Returns
    -------
    Centres and radii (n,), the rounding of the centres to floats included. All roots are in the discs; k
    discs that hang together hold k of them.

    Notes
    -----
    |z − z_i| ≤ n |p(z_i)| / Π_{j≠i} |z_i − z_j| (Smith, Error bounds for zeros of a polynomial based upon
    Gerschgorin's theorems, J. ACM 17, 1970), for any n different z_i.
    """
    exact = flint.acb_poly(polynomial)
    points = _spread([root.mid() for root in roots], bits)
    n = len(points)
    centres = np.array([complex(point) for point in points], dtype=np.complex128)
    radii = np.empty(n)
    for i, point in enumerate(points):
        apart = flint.acb(1)
        for j, other in enumerate(points):
            if j != i:
                apart *= point - other
        radius = abs(exact(point) / apart) * n
        radii[i] = float(radius.upper()) * (1 + 4 * UNIT) if radius.is_finite() else np.inf
    return centres, radii + 4 * UNIT * np.abs(centres)


def _spread(points: Sequence[Any], bits: int) -> list[Any]:
    """Move roots that are one within the precision apart, so far that rounding can't swallow what is between.

    The m-fold root of a polynomial known to 2^(−bits) is known to the m-th root of that.
    """
    near = flint.arb(2) ** (-bits // 4)
    moved = list(points)
    left = list(range(len(points)))
    while left:
        first = left[0]
        cluster = [i for i in left if i == first or not abs(points[i] - points[first]) > near]
        left = [i for i in left if i not in cluster]
        count = len(cluster)
        if count > 1:
            radius = flint.arb(2) ** (-(3 * bits) // (4 * count))
            for turn, i in enumerate(cluster):
                angle = flint.acb(flint.fmpq(2 * turn, count)).exp_pi_i()
                moved[i] = (points[first] + radius * angle).mid()
    return moved


def _sharp(proof: Proof) -> bool:
    """Say whether the largest eigenvalues are known as well as floats can tell."""
    assert proof.values is not None
    sizes = np.abs(proof.values)
    largest = sizes.max(initial=0.0)
    reaching = sizes + proof.radii >= largest - proof.radii.min(initial=np.inf)
    return bool(np.all(proof.radii[reaching] <= SHARP * max(largest, 1.0)))
