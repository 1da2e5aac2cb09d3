"""The spectral radius of a topology to fifty digits: the same equations in balls of 512 bits.

Takes: a `Model`.
Gives: `Truth`, `spectral_truth`.
Guarantees: every entry of the frame map is a ball around the exact number (see `spectrum.ball_arithmetic`),
and two precisions agree in all digits returned.
Does not: compose the frame map independently of the analysis: a mistake in the equations of the topology, in
the order of events or in the decomposition is also in the reference. Only the arithmetic is checked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import flint

from apc.analysis.analysis import lifted_classes
from apc.compiler.compiled import Model
from apc.lifting.numeric_model import numeric_model
from apc.parameter_values.parameters import resolve
from apc.spectrum.ball_arithmetic import flint_matrix, frame_balls, precision, unprovable
from apc.spectrum.interconnection import ClosedLoop, ModalSystem, close_loop
from apc.spectrum.modes import decompose, dense_loop
from apc.support.not_supported import NotSupportedError
from apc.support.state_limits import BALL_STATES

# Digits of a reference, far more than the accuracy of floats.
DIGITS = 50

# A smaller radius is zero: eigenvalues 0 are perturbed by roots of rounding errors.
LEAST = 10.0**-DIGITS

# Precisions in bits, increased until two of them agree in all digits: the first two unless a topology is very
# stiff.
PRECISIONS = (512, 1024, 2048, 4096)

# An eigenvalue with a smaller distance from 1 equals 1 (a rigid mode). Two or three such eigenvalues of one
# Jordan chain are split by at most the third root of the precision, 1e-51 at 512 bits; with damping of 1e-12
# an eigenvalue differs from 1 by 1e-14 or more.
RIGID = 1e-30

TOO_LONG = f"take too long at {DIGITS} digits"

# Graphs on which equal peers are decomposed into two or three systems, for all numbers of peers.
SPLIT = ("complete", "star")


@dataclass(frozen=True, slots=True)
class Truth:
    """The spectral radius without the eigenvalues that are 1, to `DIGITS` digits."""

    digits: str

    def error_of(self, radius: float) -> float:
        """Return the absolute error of a spectral radius."""
        return float(abs(Fraction(radius) - Fraction(self.digits)))


def spectral_truth(model: Model) -> Truth:
    """Return the spectral radius of one frame of a topology to fifty digits.

    Raises
    ------
    ApcError
        As `analysis.lifted_classes`.
    NotSupportedError
        There is no reference; the text is the reason.
    """
    systems = [close_loop(modal_system) for modal_system in _loops(model)]
    if reason := next(filter(None, map(unprovable, systems)), ""):
        raise NotSupportedError(reason)
    previous = None
    for bits in PRECISIONS:
        with precision(bits):
            result = _radius(systems)
            if previous is not None and _agree(previous, result):
                return Truth(str(result.str(DIGITS, radius=False)) if result > LEAST else "0")
            previous = result
    raise NotSupportedError(f"{DIGITS} digits are not reached with {PRECISIONS[-1]} bits")


def _loops(model: Model) -> Sequence[ModalSystem]:
    """Return the systems into which a topology is decomposed, with exact weights.

    Raises NotSupportedError for a topology that is too large.
    """
    numbers = resolve(model)
    moving = sum(
        len(rows) * len(model.peer_types[group.peer_type].states)
        for rows, group in zip(numbers.parameters, model.groups, strict=True)
    )
    if moving > BALL_STATES:
        raise NotSupportedError(f"{moving:,} states of different peers {TOO_LONG}")
    if model.peers > BALL_STATES and any(link.graph.shape not in SPLIT for link in model.links):
        raise NotSupportedError(f"{model.peers:,} peers on a graph {TOO_LONG}")
    peer_classes, comm_graph = lifted_classes(numeric_model(model))
    loops = decompose(peer_classes, comm_graph).loops
    if any(
        weight_error and coupling_term not in modal_system.surds
        for modal_system in loops
        for coupling_term, weight_error in modal_system.weight_errors.items()
    ):
        loops = (dense_loop(peer_classes, comm_graph),)  # the eigenvalues of the graph are not exact
    if sum(modal_system.states**3 for modal_system in loops) > BALL_STATES**3:
        most = max(modal_system.states for modal_system in loops)
        raise NotSupportedError(f"the eigenvalues of one system of {most:,} states {TOO_LONG}")
    return loops


def _radius(systems: Sequence[ClosedLoop]) -> Any:
    """Return the largest absolute value of the eigenvalues that are not 1, at the present precision."""
    ball = flint.arb(0)
    for closed_loop in systems:
        matrix = flint.acb_mat(flint_matrix(frame_balls(closed_loop)).mid())
        size = matrix.nrows()
        # For multiple eigenvalues each QR step gains few bits: the limit is the number of bits for each
        # eigenvalue.
        values = matrix.eig(algorithm="approx", maxiter=flint.ctx.prec * size) if size else []
        error_bound = abs(
            sum(values, flint.acb(0)) - sum((matrix[i, i] for i in range(size)), flint.acb(0))
        ).mid()
        ball = max(
            ball, *(abs(value).mid() for value in values if abs(value - 1).mid() > RIGID), flint.arb(0)
        )
        assert error_bound < RIGID * max(ball, flint.arb(1)), "QR did not converge"
    return ball


def _agree(item: Any, other: Any) -> bool:
    """Return whether two radii agree to `DIGITS` digits."""
    return bool(abs(item - other).mid() <= max(abs(other).mid(), LEAST) * flint.arb(10) ** -DIGITS)
