"""Proof in ball arithmetic that a closed system is stable or unstable.

Takes: a `ClosedLoop` and its rigid modes.
Gives: `Proof`, `prove`; `root_discs`; `MOST_PROVED`.
Guarantees: a verdict True or False is proved: every rounding since the subsystems' exact parameters is inside
a ball. An eigenvalue on the circle, or too near to it for the last precision, leaves the verdict undecided.
Does not: prove systems without exact parameters (see `ball_arithmetic.unprovable`); compute vectors.

The characteristic polynomial of the relative coordinates is computed in balls, separately for each strongly
connected part. Smith's discs about the roots of a polynomial near it enclose its roots.
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

from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF
from apc.spectrum.ball_arithmetic import (
    Balls,
    flint_matrix,
    frame_balls,
    precision,
    rational_ball,
    reduced_balls,
)
from apc.spectrum.eigenpairs import components
from apc.spectrum.enclosure import discs
from apc.spectrum.interconnection import ClosedLoop
from apc.spectrum.relative_coordinates import independent_indices
from apc.spectrum.rigid_modes import RigidModes, find_rigid_modes

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Precisions in bits, tried in turn. A frame of a thousand ticks loses some 150 of them; an eigenvalue on the
# circle is left undecided at the last.
PRECISIONS = (256, 512, 1024, 2048, 4096)

# Bits beyond which weights known as floats only gain nothing: those that a long frame loses, and twice those
# of a float.
DOUBTFUL = 512

# The limit of strongly connected states: the characteristic polynomial costs about n⁴, seconds at this size.
MOST_PROVED = 120

# Bits by which equal roots are separated: the last ones are rounded.
SPARE = 8

# The accuracy of the characteristic polynomial at 1 at which its zero is taken for a drift to search.
SETTLED = 2.0**-40


@dataclass(frozen=True, slots=True, eq=False)
class Proof:
    """The result of a proof for one closed system.

    `inside` states whether all eigenvalues but the rigid ones lie inside the unit circle, None if undecided;
    `bits` is the precision of the last attempt. `rigid_modes` include the drifts, if there are any.
    Discs about `centres` (m,) with `radii` (m,) contain the eigenvalues of the matrix in relative
    coordinates: k connected discs contain k of them. `radius_excess` bounds the excess of the largest
    magnitude over 1, from below and above.
    """

    inside: bool | None
    bits: int
    rigid_modes: RigidModes
    centres: Complexes
    radii: Floats
    radius_excess: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Discs:
    """Discs about `centres` (n,) with `radii` (n,) that contain n roots: k connected discs contain k of them.

    `least` and `most` (n,) bound the excess of a point of each disc over 1, from below and above.
    """

    centres: Complexes
    radii: Floats
    least: Floats
    most: Floats

    @property
    def radius_excess(self) -> tuple[float, float]:
        """The bounds on the excess of the largest root over 1, from below and above."""
        least = discs(self.centres, self.centres, self.radii, self.least).low
        return max(float(least), -1.0), float(self.most.max(initial=-1.0))

    @property
    def inside(self) -> bool | None:
        """Whether all roots are inside the unit circle, None if undecided."""
        least, most = self.radius_excess
        return True if most < 0 else False if least > 0 else None


def prove(closed_loop: ClosedLoop, rigid_modes: RigidModes) -> Proof:
    """Return a proof that a closed system is stable or unstable, in increasing precision.

    Parameters
    ----------
    closed_loop
        The closed system, of at most `MOST_PROVED` strongly connected states.
    rigid_modes
        The rigid modes of the system; drifts are searched only if an eigenvalue 1 remains.
    """
    searched = bool(rigid_modes.drifts) or not rigid_modes.names
    doubtful = any(
        weight_error
        for coupling_term, weight_error in closed_loop.weight_errors.items()
        if coupling_term not in closed_loop.surds
    )
    for bits in PRECISIONS:
        with precision(bits):
            matrix = frame_balls(closed_loop)
            polynomials = _polynomials(matrix, rigid_modes)
            if not searched and any(map(_may_vanish_at_unity, polynomials)):
                rigid_modes, searched = find_rigid_modes(closed_loop), True
                polynomials = _polynomials(matrix, rigid_modes)
            result = [root_discs(polynomial) for polynomial in polynomials]
            verdicts = (
                [discs.inside for discs in result] if _may_keep_rigid_modes(matrix, rigid_modes) else [None]
            )
        centres, radii = (
            np.concatenate([np.empty(0), *(getattr(discs, name) for discs in result)])
            for name in ("centres", "radii")
        )
        inside = False if False in verdicts else None if None in verdicts else True
        if inside is not None or (doubtful and bits >= DOUBTFUL):
            break
    radius_excess = [discs.radius_excess for discs in result] or [(-1.0, -1.0)]
    least, most = map(max, zip(*radius_excess, strict=True))
    return Proof(inside, bits, rigid_modes, centres, radii, (least, most))


def _polynomials(matrix: Balls, rigid_modes: RigidModes) -> list[Any]:
    """Return the characteristic polynomials of the parts of the matrix in relative coordinates."""
    reduced = reduced_balls(matrix, rigid_modes.exact, independent_indices(rigid_modes.basis.T))
    vanishing = [bool(entry == 0) for entry in reduced.ravel()]  # exactly
    driven = ~np.array(vanishing, dtype=np.bool_).reshape(reduced.shape)
    return [flint_matrix(reduced[np.ix_(part, part)]).charpoly() for part in components(driven)]


def _may_vanish_at_unity(polynomial: Any) -> bool:
    """Return whether the balls indicate a remaining eigenvalue 1."""
    at_unity = polynomial(1)
    return bool(at_unity.contains(0)) and float(at_unity.rad()) < SETTLED


def root_discs(polynomial: Any) -> Discs:
    """Return discs that enclose the roots of a polynomial whose coefficients are balls.

    Parameters
    ----------
    polynomial
        A `flint.arb_poly`, monic, of degree n.

    Notes
    -----
    |z − z_i| ≤ n |p(z_i)| / Π_{j≠i} |z_i − z_j| (Smith, Error bounds for zeros of a polynomial based upon
    Gerschgorin's theorems, J. ACM 17, 1970), for any n different z_i. They are the roots of a polynomial near
    p, whose coefficients differ from p's by their radii and rounding: a multiple root of p then becomes as
    many roots at distances that make the discs small.
    """
    coefficients = polynomial.coeffs()
    while len(coefficients) > 1 and coefficients[0] == 0:  # an eigenvalue that is exactly 0
        coefficients.pop(0)
    zero_roots = len(polynomial) - len(coefficients)
    *lower_coefficients, _ = coefficients
    n, tiny = len(lower_coefficients), flint.arb(2) ** (SPARE - flint.ctx.prec)
    points, radii = [flint.acb(0)] * n, [flint.arb("inf")] * n  # more bits may decide
    if all(item.is_finite() for item in lower_coefficients):
        nudges = [
            math.cos(k) * (item.rad() + tiny * (abs(item.mid()) + tiny))
            for k, item in enumerate(lower_coefficients)
        ]
        nearby_coefficients = [
            (item.mid() + nudge).mid() for item, nudge in zip(lower_coefficients, nudges, strict=True)
        ]
        with contextlib.suppress(ValueError):
            roots = flint.acb_poly([*nearby_coefficients, 1]).roots(tol=tiny, maxprec=4 * flint.ctx.prec)
            points = [root.mid() for root in roots]
            exact = flint.acb_poly(coefficients)
            others = (points[:i] + points[i + 1 :] for i in range(n))
            radii = [
                abs(exact(point) / math.prod((point - other for other in other_points), start=flint.acb(1)))
                * n
                for point, other_points in zip(points, others, strict=True)
            ]
    pairs = [*zip(points, radii, strict=True), *[(flint.acb(0), flint.arb(0))] * zero_roots]
    centres = np.array([complex(point) for point, _ in pairs], dtype=np.complex128)
    bounds = [(radius, radius - (abs(point) - 1), radius + (abs(point) - 1)) for point, radius in pairs]
    widths, lower_bounds, most = np.array([*map(_upper_bound, itertools.chain(*bounds))]).reshape(-1, 3).T
    return Discs(centres, widths + 2 * UNIT_ROUNDOFF * np.abs(centres), -lower_bounds, most)


def _upper_bound(value: Any) -> float:
    """Return a float that is not below any number in a ball."""
    rounded = float(value.upper()) if value.is_finite() else np.inf
    return rounded + 4 * UNIT_ROUNDOFF * abs(rounded)


def _may_keep_rigid_modes(matrix: Balls, rigid_modes: RigidModes) -> bool:
    """Return whether the balls allow M v = v for the rigid directions v.

    The directions are exact for rational weights; for other weights, a direction that depends on the weight
    would be wrong.
    """
    for vector in rigid_modes.exact[: len(rigid_modes.names)]:
        exact = [rational_ball(entry) for entry in vector]
        for row, entry_of_vector in zip(matrix, exact, strict=True):
            product = sum((a * b for a, b in zip(row, exact, strict=True) if not isinstance(b, int) or b), 0)
            if not flint.arb(product - entry_of_vector).contains(0):
                return False
    return True
