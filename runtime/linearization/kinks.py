"""Kinks: points where an equation of a peer has different slopes on different sides.

Takes: a peer type of a `Model`, a point at which it is linearized.
Gives: `Point`, `LinearPiece`, `linear_pieces_at`, `one_sided_peer_type`, `names_of`; `active_branches`;
`tie_indicators`, `refuse_kinks`, `at_a_kink`; `equal`.
Guarantees: a piece is selected by some direction of motion away from the point, to first order: slopes that
no side has are never returned. A one-sided peer type has the values of the original, and at the point the
slopes of its piece.
Does not: linearize, or combine the pieces of several peers (see `analysis.one_sided_slopes`).

At a tie of max(a, b) a symbolic derivative is the mean of both slopes. A linearization with it describes no
motion: on either side one of the two acts.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.interpolation import jacobian
from apc.linearization.branch_conditions import SwitchedPeerType, decided_peer_type, find_switches
from apc.linearization.evaluation_errors import part_of
from apc.support.threads import load_pool

# A guard of this size relative to its terms is zero: its evaluation rounds some ten times.
TIE = 2.0**-46
# The shift of a guard of zeros alone: any number that changes no other sum.
SMALLEST = 1e-300
# Slopes and values that differ by less, relative to themselves or to the largest, are equal: expressions are
# rounded in another order on each side.
EQUAL, ROUNDED = 1e-12, 1e-14
# Ties at one point: each doubles the pieces to be tried.
MOST_TIES = 8
# Peer types with cached guards.
CACHE_SIZE = 64

_GENERATED = re.compile(r"\.held\d+$")  # names of expressions that are held

_STILL = ("p", "t")  # columns that no motion changes

Floats = NDArray[np.float64]
Moving = tuple[tuple[str, tuple[float, ...]], ...]  # the columns that a motion changes, by name
Point = Mapping[str, Sequence[float]]  # the columns of `SwitchedPeerType.columns` by name


@dataclass(frozen=True, slots=True)
class LinearPiece:
    """A linear piece at a point: the chosen side of each tied decision; `moving` is the point.

    `values` are those of all functions at the point, `slopes` their slopes over all columns that a motion
    changes.
    """

    selected: tuple[tuple[int, bool], ...]
    moving: Moving
    values: Floats
    slopes: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Guards:
    """Guards, slopes and values of a peer type as functions of its columns and of the decisions' symbols."""

    guards: Any  # casadi.Function -> (guards (n,), their slopes (n, moving), size of their terms (n,))
    slopes: Any  # casadi.Function -> (values, slopes, size of the values' terms), of all functions in a row


@functools.lru_cache(maxsize=CACHE_SIZE)
def _guards(switched: SwitchedPeerType) -> _Guards:
    """Return the functions of a peer type that `linear_pieces_at` evaluates, cached."""
    columns = list(switched.columns.values())
    symbols = [decision.symbol for decision in switched.decisions]
    variables = casadi.vertcat(*columns)
    moving = casadi.vertcat(*(c for name, c in switched.columns.items() if name not in _STILL))
    guards = casadi.vertcat(*(decision.guard for decision in switched.decisions))
    terms = casadi.fabs(jacobian(guards, variables)) @ casadi.fabs(variables)
    outputs = casadi.vertcat(*(function.output for function in switched.functions))
    sizes = casadi.fabs(jacobian(outputs, variables)) @ casadi.fabs(variables)
    arguments = [*columns, casadi.vertcat(*symbols)]
    dense = casadi.densify
    return _Guards(
        casadi.Function("guards", arguments, [dense(guards), dense(jacobian(guards, moving)), dense(terms)]),
        casadi.Function("slopes", arguments, [outputs, dense(jacobian(outputs, moving)), dense(sizes)]),
    )


def linear_pieces_at(
    switched: SwitchedPeerType, point: Point, *, every: bool = False
) -> tuple[LinearPiece, ...]:
    """Return the linear pieces at a point, pieces of equal slopes once; one piece at a smooth point.

    Parameters
    ----------
    switched
        The peer type with symbols for its decisions.
    point
        The point of linearization; columns that are left out are zero.
    every
        Whether pieces of equal slopes are returned, too.

    Raises
    ------
    ApcError
        E808 an equation that jumps at the point, or more than MOST_TIES ties.
    """
    if not switched.decisions:
        return (LinearPiece((), (), np.zeros(0), np.zeros((0, 0))),)
    functions, count = _guards(switched), len(switched.decisions)
    columns = [list(point.get(name, [0.0] * c.numel())) for name, c in switched.columns.items()]
    moving = tuple(
        (name, tuple(map(float, column)))
        for name, column in zip(switched.columns, columns, strict=True)
        if name not in _STILL
    )
    leaves: list[dict[int, bool]] = []

    def follow(symbols: list[float], tied: dict[int, bool]) -> None:
        """Try both sides of each tie, in the order in which guards depend on earlier decisions."""
        index = len(symbols)
        if index == count:
            leaves.append(tied)
            return
        guards, _, terms = functions.guards(*columns, [*symbols, *[0.0] * (count - index)])
        guard, tie = float(guards[index]), max(TIE * float(terms[index]), SMALLEST)
        if not abs(guard) <= tie or not np.isfinite(tie):
            follow([*symbols, float(bool(switched.decisions[index].holds(guard)))], tied)
            return
        if switched.decisions[index].point:
            follow([*symbols, 0.0], {**tied, index: False})
            return
        if len(tied) == MOST_TIES:
            raise _refused(switched, [*tied, index], f"has more than {MOST_TIES} kinks")
        for side in (True, False):
            follow([*symbols, float(side)], {**tied, index: side})

    follow([], {})
    # The value at the point itself, where it is compared with "==": elsewhere one of the sides has it.
    points = {index for index, decision in enumerate(switched.decisions) if decision.point}
    result: list[LinearPiece] = []
    for tied in leaves:
        symbols = _symbols(switched, functions, columns, tied)
        _, rows, _ = functions.guards(*columns, symbols)
        if not _reachable(switched, np.asarray(rows, dtype=np.float64), tied):
            continue
        values, slopes, sizes = map(np.asarray, functions.slopes(*columns, symbols))
        piece = LinearPiece(tuple(tied.items()), moving, values.ravel(), slopes)
        # No number on one side alone, as of a root or logarithm there, is a jump too.
        others = [result[0].values] if result else []
        if points & tied.keys():
            point_symbols = _symbols(
                switched, functions, columns, {**tied, **dict.fromkeys(points & tied.keys(), True)}
            )
            others.append(np.asarray(functions.slopes(*columns, point_symbols)[0]).ravel())
        if any(not (np.abs(piece.values - other) <= TIE * sizes.ravel()).all() for other in others):
            raise _refused(switched, list(tied), "jumps")
        if every or not any(equal(piece.slopes, other.slopes) for other in result):
            result.append(piece)
    return tuple(result)


def active_branches(switched: SwitchedPeerType, point: Point) -> dict[str, bool]:
    """Return whether each variable with a kink is on its steepest branch, such as that of a closed contact.

    Variables whose branches all have slopes of one size, such as |x|, and those that depend on single senders
    are left out.

    Parameters
    ----------
    switched, point
        As for `linear_pieces_at`.
    """
    functions = _guards(switched)
    columns = [list(point.get(name, [0.0] * c.numel())) for name, c in switched.columns.items()]
    symbols = _symbols(switched, functions, columns, {})
    single = casadi.vertcat(*(c for name, c in switched.columns.items() if name.startswith("s")))
    decisions_by_name: dict[str, list[int]] = {}
    for index, decision in enumerate(switched.decisions):
        if not decision.point and not (single.numel() and casadi.depends_on(decision.guard, single)):
            for name in names_of(switched, [index]):
                decisions_by_name.setdefault(name, []).append(index)
    result = {}
    for name, indices in decisions_by_name.items():
        sizes = []
        for settings in itertools.product((0.0, 1.0), repeat=min(len(indices), MOST_TIES)):
            changed = [*symbols]
            for index, setting in zip(indices, settings, strict=False):
                changed[index] = setting
            sizes.append(float(np.linalg.norm(np.asarray(functions.slopes(*columns, changed)[1]))))
        size = float(np.linalg.norm(np.asarray(functions.slopes(*columns, symbols)[1])))
        if max(sizes) > min(sizes) * (1 + EQUAL):
            result[name] = size >= max(sizes) * (1 - EQUAL)
    return result


def _symbols(
    switched: SwitchedPeerType,
    functions: _Guards,
    columns: Sequence[Sequence[float]],
    tied: Mapping[int, bool],
) -> list[float]:
    """Return the value of every decision's symbol on one side of the ties.

    Parameters
    ----------
    switched, functions
        The peer type, and its guards as functions.
    columns
        The point.
    tied
        The side of each tied decision.
    """
    symbols: list[float] = [0.0] * len(switched.decisions)
    for index, decision in enumerate(switched.decisions):
        guards, *_ = functions.guards(*columns, symbols)
        symbols[index] = float(tied.get(index, bool(decision.holds(float(guards[index])))))
    return symbols


def _reachable(switched: SwitchedPeerType, rows: Floats, tied: Mapping[int, bool]) -> bool:
    """Return whether some direction of motion leads to the given sides of the ties, to first order.

    Parameters
    ----------
    switched
        The peer type.
    rows
        The slopes of all guards (n, moving). A guard without slope restricts no direction.
    tied
        The side of each tied decision.
    """
    normals = []
    for index, side in tied.items():
        size = float(np.abs(rows[index]).max(initial=0.0))
        if size > 0 and np.isfinite(size) and not switched.decisions[index].point:
            sign = 1.0 if side is switched.decisions[index].above else -1.0
            normals.append(sign * rows[index] / size)
    if len(normals) < 2:
        return True
    matrix = np.array(normals)
    if np.linalg.matrix_rank(matrix, tol=1e-6) == len(matrix):
        return True  # every combination of signs
    # A direction d with matrix d ≥ 1 exists, in a box large enough for rows that are nearly opposite.
    linprog = load_pool("scipy.optimize").linprog  # few starts need it, and its import takes long
    result = linprog(
        np.zeros(matrix.shape[1]),
        A_ub=-matrix,
        b_ub=-np.ones(len(matrix)),
        bounds=(-1e9, 1e9),
        method="highs",
    )
    return bool(result.status == 0)


def equal(first: Floats, second: Floats) -> bool:
    """Return whether slopes differ by no more than their rounding."""
    return bool(np.isclose(first, second, rtol=EQUAL, atol=_slope_tolerance(first), equal_nan=True).all())


def _slope_tolerance(values: Floats) -> float:
    """Return the absolute tolerance for the comparison of slopes, relative to the largest."""
    return ROUNDED * float(np.abs(values[np.isfinite(values)]).max(initial=0.0))


def names_of(switched: SwitchedPeerType, indices: Sequence[int]) -> tuple[str, ...]:
    """Return the names of the outputs that decisions change, each once.

    A held expression has the name of its part.
    """
    return tuple(
        dict.fromkeys(
            _GENERATED.sub("", name) for index in indices for name in switched.decisions[index].changes
        )
    )


def _refused(switched: SwitchedPeerType, indices: Sequence[int], why: str) -> ApcError:
    """Return the error for a point at which decisions are tied and no linear piece is determined."""
    names = names_of(switched, indices)
    if not names:  # a comparison with "==" has no sides to name
        symbols = [switched.decisions[index].symbol for index in indices]
        listed = (name for f in switched.functions for s in symbols for name in f.names(f.output, s))
        names = tuple(dict.fromkeys(_GENERATED.sub("", name) for name in listed))
    return at_a_kink(switched.peer_type.name, f"{', '.join(names) or 'an equation'} {why}", names)


def at_a_kink(where: str, subject: str, names: Sequence[str]) -> ApcError:
    """Return the error for a point without a linearization, at which the named variables switch."""
    text = f"{subject} at the initial state, so it can't be linearized there"
    subject = part_of(names[0]) if names else ""
    return ApcError(Diagnostic("E808", SourceLocation(where), text, subject=subject))


def one_sided_peer_type(switched: SwitchedPeerType, selected: Mapping[int, bool], moving: Moving) -> PeerType:
    """Return a peer type whose slopes at a point are those of one linear piece.

    The switching point of each tied decision is shifted by twice its tolerance, whatever the parameters are.

    Parameters
    ----------
    switched
        The peer type with symbols for its decisions.
    selected
        The side of each tied decision.
    moving
        The point.
    """
    expressions: list[Any] = []
    symbols = casadi.vertcat(*(switched.columns[name] for name, _ in moving))
    point = casadi.DM([value for _, column in moving for value in column])
    for index, decision in enumerate(switched.decisions):
        guard = _guard(switched, expressions)
        if decision.point:
            expressions.append(casadi.SX(0) if index in selected else decision.holds(guard))
            continue
        if index in selected:
            terms = casadi.substitute(_term_size(switched, guard), symbols, point)
            shift = 2 * casadi.fmax(TIE * terms, SMALLEST)
            guard += shift if selected[index] is decision.above else -shift
        expressions.append(decision.holds(guard))
    return decided_peer_type(switched, expressions)


def _guard(switched: SwitchedPeerType, earlier: Sequence[Any]) -> Any:
    """Return the guard of the next decision, with the expressions of all earlier decisions."""
    symbols = [decision.symbol for decision in switched.decisions[: len(earlier)]]
    guard = switched.decisions[len(earlier)].guard
    return casadi.substitute(guard, casadi.vertcat(*symbols), casadi.vertcat(*earlier)) if earlier else guard


def _term_size(switched: SwitchedPeerType, guard: Any) -> Any:
    """Return the sum of the magnitudes of the terms of a guard, which bounds its rounding."""
    variables = casadi.vertcat(*switched.columns.values())
    return casadi.fabs(jacobian(guard, variables)) @ casadi.fabs(variables)


@functools.lru_cache(maxsize=CACHE_SIZE)
def tie_indicators(peer_type: PeerType) -> Any | None:
    """Return a function (x, u, m, r, p, t) -> (n,) that is above 0 where a decision is tied.

    Its arguments are those of `SubsystemJacobians.function`. Not every tie is a kink: see `linear_pieces_at`.
    None where nothing depends on a decision, where a nonlinear loop hides the decisions, or where values of
    single senders decide.
    """
    switched = find_switches(peer_type)
    if not switched.decisions:
        return None
    columns = switched.columns
    outputs = casadi.vertcat(*(item.output for item in switched.functions if item.where[0] != "edge"))
    guards = casadi.vertcat(*(decision.guard for decision in switched.decisions))
    expressions: list[Any] = []
    ties: list[Any] = []
    for decision in switched.decisions:
        guard = _guard(switched, expressions)
        expressions.append(decision.holds(guard))
        if casadi.depends_on(casadi.vertcat(outputs, guards), decision.symbol):
            ties.append(casadi.fabs(guard) <= TIE * _term_size(switched, guard))
    if not ties:
        return None
    column = casadi.vertcat(*ties)
    if any(casadi.depends_on(column, c) for name, c in columns.items() if name.startswith("s")):
        return None
    m, r = (
        casadi.vertcat(*(columns.get(f"{letter}{p}", casadi.SX(0, 1)) for p in range(len(peer_type.clocks))))
        for letter in "mr"
    )
    arguments = [columns["x"], columns["u"], m, r, columns["p"], columns["t"]]
    return casadi.Function("ties", arguments, [casadi.densify(column)])


def refuse_kinks(peer_type: PeerType, where: str, point: Point) -> None:
    """Raise ApcError E808 for a point at which slopes differ from side to side."""
    switched = find_switches(peer_type)
    pieces = linear_pieces_at(switched, point)
    if len(pieces) > 1:
        names = names_of(switched, [index for index, _ in pieces[0].selected])
        raise at_a_kink(where, f"{', '.join(names) or 'an equation'} of {where} has a kink", names)
