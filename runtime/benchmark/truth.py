"""The spectral radius of a topology to fifty digits: the same equations in balls of 512 bits.

Takes: a `Model`.
Gives: `Truth`, `spectral_truth`.
Guarantees: every entry of a frame's matrix is a ball about the true number (see `eigen.ball_arithmetic`), and
two precisions agree on every digit given.
Does not: compose the frame by another way than the analysis: a mistake in the topology's own equations, in
the order of events or in how a topology falls into systems is the truth's too. What it judges is arithmetic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import flint

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import Model
from apc.eigen.ball_arithmetic import frame_balls, precision, square, unprovable
from apc.eigen.interconnection import ClosedLoop, ModalSystem, close_loop
from apc.eigen.modes import decompose, dense_loop
from apc.frame.parameters import resolve
from apc.not_supported import NotSupportedError

# What is asked of a reference, relative to the largest: far beyond what floats can be wrong by.
DIGITS = 50

# A radius below this is none: eigenvalues 0, that the roots of roundings hide.
LEAST = 10.0**-DIGITS

# Bits tried in turn until two of them agree on the digits; the first two do unless a topology is very stiff.
PRECISIONS = (512, 1024, 2048, 4096)

# An eigenvalue so near to 1 is 1: a motion that nothing hinders. A pair or a triple of them that belongs to
# one chain is split by the third root of the precision at worst, 1e-51 at 512 bits; what damping of 1e-12
# leaves differs by 1e-14 or more.
RIGID = 1e-30

# Eigenvalues of larger matrices, or of so many small ones, take minutes at this precision.
MOST_STATES = 110
TOO_LONG = f"take too long at {DIGITS} digits"

# Graphs on which equal peers make two or three systems, however many they are.
SPLIT = ("complete", "star")


@dataclass(frozen=True, slots=True)
class Truth:
    """The spectral radius, without the eigenvalues that are 1: its first `DIGITS` digits."""

    digits: str

    def error_of(self, radius: float) -> float:
        """Return how far a radius is from the truth."""
        return float(abs(Fraction(radius) - Fraction(self.digits)))


def spectral_truth(system: Model) -> Truth:
    """Return the truth about one frame of a topology.

    Raises
    ------
    ApcError
        As `analysis.lifted_groups`.
    NotSupportedError
        Why there is none.
    """
    systems = [close_loop(loop) for loop in _loops(system)]
    if reason := next(filter(None, map(unprovable, systems)), ""):
        raise NotSupportedError(reason)
    last = None
    for bits in PRECISIONS:
        with precision(bits):
            result = _radius(systems)
            if last is not None and _agree(last, result):
                return Truth(str(result.str(DIGITS, radius=False)) if result > LEAST else "0")
            last = result
    raise NotSupportedError(f"not certain to {DIGITS} digits at {PRECISIONS[-1]} bits")


def _loops(system: Model) -> Sequence[ModalSystem]:
    """Return the systems that a topology falls into, each of weights known exactly; refuse what is too
    large.
    """
    numbers = resolve(system)
    moving = sum(
        len(rows) * len(system.peer_types[group.peer_type].states)
        for rows, group in zip(numbers.parameters, system.groups, strict=True)
    )
    if moving > MOST_STATES:
        raise NotSupportedError(f"{moving:,} states of motion of different peers {TOO_LONG}")
    if system.peers > MOST_STATES and any(link.graph.shape not in SPLIT for link in system.links):
        raise NotSupportedError(f"{system.peers:,} peers on a graph {TOO_LONG}")
    groups, exchange = lifted_groups(system)
    loops = decompose(groups, exchange).loops
    if any(
        weight_error and coupling_term not in loop.surds
        for loop in loops
        for coupling_term, weight_error in loop.weight_errors.items()
    ):
        loops = (dense_loop(groups, exchange),)  # the eigenvalues of its graph are floats
    if sum(loop.states**3 for loop in loops) > MOST_STATES**3:
        most = max(loop.states for loop in loops)
        raise NotSupportedError(f"eigenvalues of {most:,} states together {TOO_LONG}")
    return loops


def _radius(systems: Sequence[ClosedLoop]) -> Any:
    """Return the largest magnitude of an eigenvalue that is not 1, at the present precision."""
    ball = flint.arb(0)
    for system in systems:
        matrix = flint.acb_mat(square(frame_balls(system)).mid())
        size = matrix.nrows()
        # Of a chain of equal eigenvalues each step of QR gains a few bits: as many steps as bits, each.
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
    return bool(abs(item - other).mid() <= max(abs(other).mid(), LEAST) * flint.arb(10) ** -DIGITS)
