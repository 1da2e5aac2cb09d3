"""Proof in ball arithmetic that a closed system is stable, or that it is not.

Takes: a `ClosedSystem` and its rigid modes.
Gives: `Proof`, `prove`; `schur_cohn`; `MOST_PROVED`.
Guarantees: a verdict True or False is proved: every rounding since the sites' exact numbers is inside a ball.
What is too near the circle for the last precision is left open, and so is what lies on it.
Does not: prove what its numbers can't be had exactly for (see `balls.unprovable`).

The characteristic polynomial of the relative coordinates comes in balls, each part (see `enclosure`) its own.
Smith's discs enclose its roots (see `roots`); where one reaches over the circle, Schur and Cohn's recursion
decides without an eigenvalue being known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

from apc.eigen.balls import Balls, frame_balls, precision, rational_ball, reduced_balls, square
from apc.eigen.closing import ClosedSystem
from apc.eigen.eigenpairs import components
from apc.eigen.enclosure import discs
from apc.eigen.relative import independent_places
from apc.eigen.rigid import RigidModes, find_rigid_modes
from apc.eigen.roots import approach_roots, root_discs

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Places = NDArray[np.intp]

# Bits tried in turn. A frame of a thousand ticks loses some 150 of them; what lies on the circle is left
# undecided at the last.
PRECISIONS = (256, 512, 1024, 2048, 4096)

# Bits at which weights known as floats only let nothing more be gained: those a long frame loses, and twice
# those of a float.
DOUBTFUL = 512

# More states that drive each other than this aren't proved: the characteristic polynomial costs n⁴ or so,
# seconds at this size.
MOST_PROVED = 120

# Of more states than this no vectors are computed: they cost n⁴, too, seconds at this size.
MOST_VECTORS = 80

# Bits of the vectors: what is hidden beneath the largest entry by 1e-24 still has 30 digits.
VECTOR_BITS = 256

# What floats may be off by when they add up a disc.
ROUNDED = 2.0**-50

# A radius known so well needs no more bits: floats can't tell it better.
SHARP = 2.0**-50

# A verdict that is proved isn't followed by more than so many times its bits, for a sharper radius.
SHARPENING = 4

# Multiples of it, whole numbers left out, are spread evenly and favour no symmetry (Weyl): what inverse
# iteration starts from.
GOLDEN = (5**0.5 - 1) / 2

# What the characteristic polynomial at 1 is known to before its vanishing is taken for a drift to look for.
SETTLED = 2.0**-40


@dataclass(frozen=True, slots=True, eq=False)
class Proof:
    """What was proved of one closed system.

    `inside` says whether all eigenvalues but the rigid ones lie inside the unit circle, None if that is left
    open; `bits` with how many bits it was decided, or left open. `free` are the rigid modes, drifts included
    if there are any. Of the matrix in relative coordinates, `values` (m,) are eigenvalues, and `radii` (m,)
    those of discs about them: k discs that hang together hold k eigenvalues. `right` (m, m) are their vectors
    as columns, `left` as rows; None where these are too many. Without rigid modes each is that of the part
    its eigenvalue belongs to: the products of right and left ones are zero elsewhere.
    """

    inside: bool | None
    bits: int
    free: RigidModes
    values: Complexes
    radii: Floats
    right: Complexes | None
    left: Complexes | None


def prove(system: ClosedSystem, free: RigidModes, held: Places, *, verdict_only: bool = False) -> Proof:
    """Prove a closed system stable or unstable, in rising precision.

    Parameters
    ----------
    system
        The closed system, of at most `MOST_PROVED` states.
    free
        Its rigid modes; drifts are looked for only where the eigenvalue 1 remains without them.
    held
        As many places of the state as there are rigid motions, at which these are independent.
    verdict_only
        Leave the eigenvalues out: Schur and Cohn decide.
    """
    searched = bool(free.drifts) or not free.names
    best, settled = None, 0
    for bits in PRECISIONS:
        with precision(bits):
            matrix = frame_balls(system)
            reduced = reduced_balls(matrix, free.exact, held)
            parts = _parts(reduced)
            if not searched and any(_may_be_one(part.polynomial) for part in parts):
                free, searched = find_rigid_modes(system), True
                if free.drifts:
                    held = independent_places(free.basis.T)
                    reduced = reduced_balls(matrix, free.exact, held)
                    parts = _parts(reduced)
            roots = [
                approach_roots(part.polynomial, part.guesses, bits) for part in parts if not verdict_only
            ]
            values, radii = np.empty(0, np.complex128), np.empty(0)
            if not verdict_only:
                values, radii = _enclosed(parts, roots, bits)
            inside = _inside(parts, values, radii) if _stands_still(matrix, free) else None
            settled = settled or (bits if inside is not None else 0)
            if best is not None and inside is None and bits != PRECISIONS[-1]:
                continue
            right = left = None
            if not verdict_only:
                right, left = _vectors_of(parts, roots, reduced if free.exact else None)
            best = Proof(inside, settled or bits, free, values, radii, right, left)
        if inside is not None and (_sharp(best) or bits >= SHARPENING * settled):
            break
        if any(doubt for way, doubt in system.doubts.items() if way not in system.surds) and bits >= DOUBTFUL:
            break
    assert best is not None
    return best


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """States that drive each other: their `places` among n, their `block` in balls, its polynomial.

    `guesses` are its eigenvalues in floats.
    """

    places: Places
    block: Any  # flint.arb_mat
    polynomial: Any  # flint.arb_poly
    guesses: Complexes


def _parts(reduced: Balls) -> list[_Part]:
    """Return the parts of the matrix in relative coordinates."""
    vanishing = np.array([[bool(entry == 0) for entry in row] for row in reduced], dtype=np.bool_)  # exactly
    found = []
    for places in components(~vanishing.reshape(reduced.shape)):
        block = square(reduced[np.ix_(places, places)])
        found.append(_Part(places, block, block.charpoly(), _guesses(block)))
    return found


def _guesses(block: Any) -> Complexes:
    """Return the eigenvalues in floats; entries beyond their range count for nothing."""
    n = block.nrows()
    middle = np.array([float(entry.mid()) for entry in block.entries()], dtype=np.float64).reshape(n, n)
    return np.linalg.eigvals(np.where(np.isfinite(middle), middle, 0.0)).astype(np.complex128)


def _may_be_one(polynomial: Any) -> bool:
    """Say whether an eigenvalue 1 is left, as far as the balls tell, and they tell much."""
    at_one = polynomial(1)
    return bool(at_one.contains(0)) and float(at_one.rad()) < SETTLED


def _enclosed(parts: Sequence[_Part], roots: Sequence[Sequence[Any]], bits: int) -> tuple[Complexes, Floats]:
    """Return the centres and radii of discs about the eigenvalues of all parts."""
    n = sum(len(part.places) for part in parts)
    values, radii = np.zeros(n, dtype=np.complex128), np.zeros(n)
    for part, own in zip(parts, roots, strict=True):
        values[part.places], radii[part.places] = root_discs(part.polynomial, own, bits)
    return values, radii


def _inside(parts: Sequence[_Part], values: Complexes, radii: Floats) -> bool | None:
    """Say whether all eigenvalues of all parts lie inside the unit circle, None if that is open.

    The discs tell, unless one reaches over the circle; then Schur and Cohn, who need more bits where there
    are many eigenvalues, but come as near to the circle as the balls allow.
    """
    if len(values):
        found = discs(values, values, radii)
        if found.high < 1 - ROUNDED:
            return True
        if found.low > 1 + ROUNDED:
            return False
    verdicts = [schur_cohn(part.polynomial.coeffs()) for part in parts]
    return False if False in verdicts else None if None in verdicts else True


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


def _vectors_of(
    parts: Sequence[_Part], roots: Sequence[Sequence[Any]], whole: Balls | None
) -> tuple[Complexes | None, Complexes | None]:
    """Return the right vectors of all eigenvalues as columns, the left ones as rows; None if too many.

    `whole` is the matrix whose vectors are asked for; without it they are the parts'.
    """
    n = sum(len(part.places) for part in parts)
    within = [part.places if whole is None else np.arange(n) for part in parts]
    if any(len(places) > MOST_VECTORS for places in within):
        return None, None
    right, left = np.zeros((n, n), dtype=np.complex128), np.zeros((n, n), dtype=np.complex128)
    with precision(VECTOR_BITS):
        everything = None if whole is None else square(whole)
        for part, places, values in zip(parts, within, roots, strict=True):
            block = part.block if everything is None else everything
            right[np.ix_(places, part.places)] = _vectors(block, values).T
            left[np.ix_(part.places, places)] = _vectors(block.transpose(), values)
    return right, left


def _vectors(matrix: Any, values: Sequence[Any]) -> Complexes:
    """Return right vectors of k eigenvalues of a real matrix as rows (k, n), the largest entry of each one.

    One step of inverse iteration a third of the bits beside the eigenvalue. Equal ones get the same vector, a
    conjugate its partner's conjugate.
    """
    n = matrix.nrows()
    size = max((float(abs(entry).mid()) for entry in matrix.entries()), default=0.0) or 1.0
    aside = flint.arb(2) ** (-VECTOR_BITS // 3)
    start = flint.acb_mat(n, 1, [flint.acb(one) for one in (np.arange(1, n + 1) * GOLDEN % 1 + 0.5).tolist()])
    middle = flint.acb_mat(matrix.mid())
    found = np.zeros((len(values), n), dtype=np.complex128)
    rough = np.array([complex(value) for value in values], dtype=np.complex128)
    for line, value in enumerate(values):
        before = np.flatnonzero((rough[:line] == rough[line]) | (rough[:line] == rough[line].conjugate()))
        if len(before):
            partner = int(before[0])
            found[line] = found[partner] if rough[partner] == rough[line] else found[partner].conjugate()
            continue
        near = (value + aside * max(abs(value).mid(), aside * size)).mid()
        shifted = middle - flint.acb_mat([[near if i == j else 0 for j in range(n)] for i in range(n)])
        try:
            row = shifted.solve(start, algorithm="approx").entries()
        except ZeroDivisionError:
            continue
        largest = max(row, key=lambda entry: abs(entry).mid()).mid()
        if not largest.contains(0) and largest.is_finite():
            found[line] = [complex(entry.mid() / largest) for entry in row]
    return found


def _sharp(proof: Proof) -> bool:
    """Say whether the largest eigenvalues are known as well as floats can tell."""
    sizes = np.abs(proof.values)
    largest = sizes.max(initial=0.0)
    reaching = sizes + proof.radii >= largest - proof.radii.min(initial=np.inf)
    return bool(np.all(proof.radii[reaching] <= SHARP * max(largest, 1.0)))
