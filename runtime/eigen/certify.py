"""Proof in ball arithmetic that a closed system is stable, or that it is not.

Takes: a `ClosedSystem` and its rigid modes.
Gives: `Proof`, `prove`; `schur_cohn`; `MOST_PROVED`.
Guarantees: a verdict True or False is proved: every rounding since the sites' exact numbers is inside a ball.
What is too near the circle for the last precision is left open, and so is what lies on it.
Does not: prove what its numbers can't be had exactly for (see `balls.unprovable`); give vectors.

The characteristic polynomial of the relative coordinates comes in balls, that of each strongly connected part
by itself. Smith's discs enclose its roots; where one reaches over the circle, Schur and Cohn's recursion
decides without an eigenvalue being known.
"""

from __future__ import annotations

import itertools
import math
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

# Bits tried in turn. A frame of a thousand ticks loses some 150 of them; what lies on the circle is left
# undecided at the last.
PRECISIONS = (256, 512, 1024, 2048, 4096)

# Bits at which weights known as floats only let nothing more be gained: those a long frame loses, and twice
# those of a float.
DOUBTFUL = 512

# More states that drive each other than this aren't proved: the characteristic polynomial costs n⁴ or so,
# seconds at this size.
MOST_PROVED = 120

# A radius known so well needs no more bits: floats can't tell it better.
SHARP = 2.0**-50

# A verdict that is proved isn't followed by more than so many times its bits, for a sharper radius.
SHARPENING = 4

# What the characteristic polynomial at 1 is known to before its vanishing is taken for a drift to look for.
SETTLED = 2.0**-40


@dataclass(frozen=True, slots=True, eq=False)
class Proof:
    """What was proved of one closed system.

    `inside` says whether all eigenvalues but the rigid ones lie inside the unit circle, None if that is left
    open; `bits` with how many bits it was decided, or left open. `free` are the rigid modes, drifts included
    if there are any. Of the matrix in relative coordinates, `values` (m,) estimate the eigenvalues, and
    discs about `centres` (m,) with `radii` (m,) hold them: k discs that hang together hold k eigenvalues. The
    centres of roots that are one within the precision are spread, the estimates are not.
    """

    inside: bool | None
    bits: int
    free: RigidModes
    values: Complexes
    centres: Complexes
    radii: Floats


def prove(system: ClosedSystem, free: RigidModes) -> Proof:
    """Prove a closed system stable or unstable, in rising precision.

    Parameters
    ----------
    system
        The closed system, of at most `MOST_PROVED` states that drive each other.
    free
        Its rigid modes; drifts are looked for only where the eigenvalue 1 remains without them.
    """
    searched = bool(free.drifts) or not free.names
    best, settled = None, 0
    for bits in PRECISIONS:
        with precision(bits):
            matrix = frame_balls(system)
            polynomials = _polynomials(matrix, free)
            if not searched and any(_may_vanish_at_one(one) for one, _ in polynomials):
                free, searched = find_rigid_modes(system), True
                polynomials = _polynomials(matrix, free)
            values, centres, wide = np.concatenate(
                [np.empty((3, 0)), *itertools.starmap(_root_discs, polynomials)], axis=1
            )
            radii = wide.real
            inside = (
                _inside([one for one, _ in polynomials], centres, radii)
                if _stands_still(matrix, free)
                else None
            )
        settled = settled or (bits if inside is not None else 0)
        if best is None or inside is not None or bits == PRECISIONS[-1]:
            best = Proof(inside, settled or bits, free, values, centres, radii)
        if inside is not None and (_sharp(best) or bits >= SHARPENING * settled):
            break
        if any(doubt for way, doubt in system.doubts.items() if way not in system.surds) and bits >= DOUBTFUL:
            break
    assert best is not None
    return best


def _polynomials(matrix: Balls, free: RigidModes) -> list[tuple[Any, Complexes]]:
    """Return the characteristic polynomials of the parts of the matrix in relative coordinates.

    Each comes with what its roots are in floats.
    """
    reduced = reduced_balls(matrix, free.exact, independent_places(free.basis.T))
    vanishing = [bool(entry == 0) for entry in reduced.ravel()]  # exactly
    driven = ~np.array(vanishing, dtype=np.bool_).reshape(reduced.shape)
    blocks = [reduced[np.ix_(part, part)] for part in components(driven)]
    return [(square(block).charpoly(), _eigenvalues(block)) for block in blocks]


def _eigenvalues(block: Balls) -> Complexes:
    """Return the eigenvalues (n,) of the middles of balls (n, n), in floats."""
    middles = np.array([float(flint.arb(one).mid()) for one in block.ravel()]).reshape(block.shape)
    if not np.isfinite(middles).all():
        return np.zeros(len(block), dtype=np.complex128)
    return np.linalg.eigvals(middles).astype(np.complex128)


def _may_vanish_at_one(polynomial: Any) -> bool:
    """Say whether an eigenvalue 1 is left, as far as the balls tell, and they tell much."""
    at_one = polynomial(1)
    return bool(at_one.contains(0)) and float(at_one.rad()) < SETTLED


def _root_discs(polynomial: Any, guesses: Complexes) -> Complexes:
    """Estimate and enclose the roots of a monic polynomial of degree n, from guesses (n,).

    Returns
    -------
    The estimates, then the centres and the radii of discs (3, n). All roots are in the discs; k discs
    that hang together hold k of them.
    """
    coefficients = polynomial.coeffs()
    if not all(math.isfinite(float(one.abs_upper())) for one in coefficients):  # more bits may tell
        nothing = np.zeros(len(coefficients) - 1, dtype=np.complex128)
        return np.stack([nothing, nothing, nothing + np.inf])
    bits = flint.ctx.prec
    roots = approach_roots(polynomial, guesses, bits)
    centres, radii = root_discs(polynomial, roots, bits)
    return np.stack([np.array([complex(root) for root in roots], dtype=np.complex128), centres, radii])


def _inside(polynomials: Sequence[Any], centres: Complexes, radii: Floats) -> bool | None:
    """Say whether all eigenvalues of all parts lie inside the unit circle, None if that is open.

    The discs tell, unless one reaches over the circle; then Schur and Cohn, who need more bits where there
    are many eigenvalues, but come as near to the circle as the balls allow.
    """
    found = discs(centres, centres, radii)
    if found.high < 1:
        return True
    if found.low > 1:
        return False
    verdicts = [schur_cohn(one.coeffs()) for one in polynomials]
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


def _sharp(proof: Proof) -> bool:
    """Say whether the largest eigenvalues are known as well as floats can tell."""
    sizes = np.abs(proof.centres)
    largest = sizes.max(initial=0.0)
    reaching = sizes + proof.radii >= largest - proof.radii.min(initial=np.inf)
    return bool(np.all(proof.radii[reaching] <= SHARP * max(largest, 1.0)))
