"""Proof in ball arithmetic that a closed system is stable, or that it is not.

Takes: a `ClosedLoop` and its rigid modes.
Gives: `Proof`, `prove`; `root_discs`; `MOST_PROVED`.
Guarantees: a verdict True or False is proved: every rounding since the sites' exact numbers is inside a ball.
What is too near the circle for the last precision is left open, and so is what lies on it.
Does not: prove what its numbers can't be had exactly for (see `balls.unprovable`); give vectors.

The characteristic polynomial of the relative coordinates comes in balls, that of each strongly connected part
by itself. Smith's discs about the roots of a polynomial beside it enclose its roots.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from dataclasses import dataclass
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

from apc.eigen.balls import Balls, frame_balls, precision, rational_ball, reduced_balls, square
from apc.eigen.closing import ClosedLoop
from apc.eigen.eigenpairs import components
from apc.eigen.enclosure import discs
from apc.eigen.relative import independent_places
from apc.eigen.rigid import RigidModes, find_rigid_modes
from apc.frame.radius import UNIT

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

# Bits by which a root is moved from one that it is equal to: the last ones are rounded.
SPARE = 8

# What the characteristic polynomial at 1 is known to before its vanishing is taken for a drift to look for.
SETTLED = 2.0**-40


@dataclass(frozen=True, slots=True, eq=False)
class Proof:
    """What was proved of one closed system.

    `inside` says whether all eigenvalues but the rigid ones lie inside the unit circle, None if that is left
    open; `bits` with how many bits it was decided, or left open. `free` are the rigid modes, drifts included
    if there are any. Discs about `centres` (m,) with `radii` (m,) hold the eigenvalues of the matrix in
    relative coordinates: k discs that hang together hold k of them. `beyond` is how much larger than 1 the
    largest of these is, at least and at most.
    """

    inside: bool | None
    bits: int
    free: RigidModes
    centres: Complexes
    radii: Floats
    beyond: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Discs:
    """Discs about `centres` (n,) with `radii` (n,) that hold n roots: k that hang together hold k of them.

    `least` and `most` (n,) are how much larger than 1 a point of each is at least and at most.
    """

    centres: Complexes
    radii: Floats
    least: Floats
    most: Floats

    @property
    def beyond(self) -> tuple[float, float]:
        """How much larger than 1 the largest root is, at least and at most."""
        least = discs(self.centres, self.centres, self.radii, self.least).low
        return max(float(least), -1.0), float(self.most.max(initial=-1.0))

    @property
    def inside(self) -> bool | None:
        """Say whether all roots are inside the unit circle, None if that is open."""
        least, most = self.beyond
        return True if most < 0 else False if least > 0 else None


def prove(system: ClosedLoop, free: RigidModes) -> Proof:
    """Prove a closed system stable or unstable, in rising precision.

    Parameters
    ----------
    system
        The closed system, of at most `MOST_PROVED` states that drive each other.
    free
        Its rigid modes; drifts are looked for only where the eigenvalue 1 remains without them.
    """
    searched = bool(free.drifts) or not free.names
    doubtful = any(doubt for way, doubt in system.doubts.items() if way not in system.surds)
    for bits in PRECISIONS:
        with precision(bits):
            matrix = frame_balls(system)
            polynomials = _polynomials(matrix, free)
            if not searched and any(map(_may_vanish_at_one, polynomials)):
                free, searched = find_rigid_modes(system), True
                polynomials = _polynomials(matrix, free)
            result = [root_discs(polynomial) for polynomial in polynomials]
            verdicts = [discs.inside for discs in result] if _stands_still(matrix, free) else [None]
        centres, radii = (
            np.concatenate([np.empty(0), *(getattr(discs, name) for discs in result)])
            for name in ("centres", "radii")
        )
        inside = False if False in verdicts else None if None in verdicts else True
        if inside is not None or (doubtful and bits >= DOUBTFUL):
            break
    beyond = [discs.beyond for discs in result] or [(-1.0, -1.0)]
    least, most = map(max, zip(*beyond, strict=True))
    return Proof(inside, bits, free, centres, radii, (least, most))


def _polynomials(matrix: Balls, free: RigidModes) -> list[Any]:
    """Return the characteristic polynomials of the parts of the matrix in relative coordinates."""
    reduced = reduced_balls(matrix, free.exact, independent_places(free.basis.T))
    vanishing = [bool(entry == 0) for entry in reduced.ravel()]  # exactly
    driven = ~np.array(vanishing, dtype=np.bool_).reshape(reduced.shape)
    return [square(reduced[np.ix_(part, part)]).charpoly() for part in components(driven)]


def _may_vanish_at_one(polynomial: Any) -> bool:
    """Say whether an eigenvalue 1 is left, as far as the balls tell, and they tell much."""
    at_one = polynomial(1)
    return bool(at_one.contains(0)) and float(at_one.rad()) < SETTLED


def root_discs(polynomial: Any) -> Discs:
    """Enclose the roots of a polynomial whose coefficients are balls in discs.

    Parameters
    ----------
    polynomial
        A `flint.arb_poly`, monic, of degree n.

    Notes
    -----
    |z − z_i| ≤ n |p(z_i)| / Π_{j≠i} |z_i − z_j| (Smith, Error bounds for zeros of a polynomial based upon
    Gerschgorin's theorems, J. ACM 17, 1970), for any n different z_i. They are the roots of a polynomial
    beside p, each coefficient off by as much as p's is not known, or rounded: what is a multiple root of p
    is there so many as far from each other as makes the discs small.
    """
    coefficients = polynomial.coeffs()
    while len(coefficients) > 1 and coefficients[0] == 0:  # an eigenvalue that is exactly 0
        coefficients.pop(0)
    gone = len(polynomial) - len(coefficients)
    *lower, _ = coefficients
    n, tiny = len(lower), flint.arb(2) ** (SPARE - flint.ctx.prec)
    points, radii = [flint.acb(0)] * n, [flint.arb("inf")] * n  # more bits may tell
    if all(item.is_finite() for item in lower):
        nudges = [
            math.cos(k) * (item.rad() + tiny * (abs(item.mid()) + tiny)) for k, item in enumerate(lower)
        ]
        beside = [(item.mid() + by).mid() for item, by in zip(lower, nudges, strict=True)]
        with contextlib.suppress(ValueError):
            roots = flint.acb_poly([*beside, 1]).roots(tol=tiny, maxprec=4 * flint.ctx.prec)
            points = [root.mid() for root in roots]
            exact = flint.acb_poly(coefficients)
            others = (points[:i] + points[i + 1 :] for i in range(n))
            radii = [
                abs(exact(point) / math.prod((point - other for other in rest), start=flint.acb(1))) * n
                for point, rest in zip(points, others, strict=True)
            ]
    pairs = [*zip(points, radii, strict=True), *[(flint.acb(0), flint.arb(0))] * gone]
    centres = np.array([complex(point) for point, _ in pairs], dtype=np.complex128)
    within = [(radius, radius - (abs(point) - 1), radius + (abs(point) - 1)) for point, radius in pairs]
    widths, less, most = np.array([*map(_above, itertools.chain(*within))]).reshape(-1, 3).T
    return Discs(centres, widths + 2 * UNIT * np.abs(centres), -less, most)


def _above(value: Any) -> float:
    """Return a float that is not below a ball."""
    known = float(value.upper()) if value.is_finite() else np.inf
    return known + 4 * UNIT * abs(known)


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
