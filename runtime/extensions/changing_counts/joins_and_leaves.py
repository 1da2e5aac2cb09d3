"""Stability under changes of the number of peers: users who join and leave.

Takes: a `NumericModel`, the number of peers of one group, and its values.
Gives: `changing_counts`, `ChangingCounts`, `MotionFamily`, `ChangeVerdict`.
Guarantees: "stable under arbitrary changes", a dwell time and a growing sequence are proved, with all
rounding included, for the nominal network.
Does not: treat peers that are not interchangeable; find the shortest dwell time.

The peers of a group are equal and receive each other's mean or sum. With x̄ the mean of their states and d_i
the deviation of peer i, a frame is x̄⁺ = M_c(N) x̄ and d_i⁺ = M_d(N) d_i. A peer that joins starts at the mean
of the others, in all its states and packets (`joining: mean` of every part): no deviation changes. A peer
that leaves takes its deviation with it. Let V = Σ_i d_iᵀ P d_i. A join leaves V unchanged; a leave lowers it
by (1 + 1/(N − 1)) d_iᵀ P d_i. If M_d(N)ᵀ P M_d(N) ≺ P for every N, V decays under any sequence of changes at
the starts of frames, and so do the jumps of x̄. If moreover M_c(N)ᵀ P_c M_c(N) ≺ P_c for every N, all motions
decay.

Otherwise each N has a P_N of its own. With M_Nᵀ P_N M_N ≺ P_N and (M_N^k)ᵀ P_L M_N^k ≺ P_N for all N, L, all
motions decay if at least k frames pass between changes (Geromel and Colaneri, SIAM Journal on Control and
Optimization 45, 2006).

A product of matrices with a spectral radius above 1 is a sequence of changes under which motions grow: peers
that stay have deviations of opposite sign, and those that join and leave have none.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import lifted_classes
from apc.analysis.one_sided_slopes import sides
from apc.compiler.compiled import Model, group_count
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.lifting.interval_arithmetic import MIDPOINT_RADIUS, error_radius, value_of, with_error_radius
from apc.lifting.numeric_model import NumericModel
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import ParameterRef, find
from apc.result import Result
from apc.simulation.presence import stored_names
from apc.spectrum.eigenpairs import largest_magnitudes
from apc.spectrum.enclosure import enclose_eigenvalues
from apc.spectrum.kyp_bounds import is_positive
from apc.spectrum.lyapunov_functions import balanced, decreases, has_common_function
from apc.spectrum.modes import decompose, split
from apc.spectrum.relative_coordinates import relative, with_uncertainty
from apc.studies.grid import parse_axis
from apc.studies.loop_structure import loop_structure
from apc.support.threads import load_pool, single_threaded
from apc.verdict import Term

Floats = NDArray[np.float64]
Matrix = NDArray[Any]  # (2, n, n): midpoints and radii

LOCATION = SourceLocation("--changing")

# Counts, and states of a family: the semidefinite program has their product of inequalities.
MOST_COUNTS, MOST_STATES = 40, 40

# Dwell times in frames; products of matrices that are examined, their lengths and their different factors.
MOST_FRAMES, MOST_PRODUCTS, LONGEST, MOST_FACTORS = 4096, 20_000, 8, 8

# A longer sequence is preferred if it grows faster by this, relatively.
CLEARLY = 1e-9


class ChangeVerdict(Term):
    """The verdict under changes of the number of peers."""

    ARBITRARY = "stable under arbitrary changes"
    DWELL = "stable under rare changes"
    UNSTABLE = "unstable under a sequence of changes"
    UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True)
class MotionFamily:
    """A family of motions, such as the common ones, with `states` states, over all counts.

    `common` states whether one quadratic function is proved to decrease for every count. `dwell_frames` is
    the proved number of frames between changes that suffices (1 with a common function), None without one.
    `sequence` are counts of successive frames under whose repetition motions grow by `growth` per frame, in
    the mean.
    """

    name: str
    states: int
    common: bool
    dwell_frames: int | None
    sequence: tuple[int, ...]
    growth: float


@dataclass(frozen=True, slots=True)
class ChangingCounts(Result):
    """The stability of a model while peers join and leave; times are in seconds.

    `counts` are the numbers of peers of `parameter`. `dwell_frames` and `dwell_s` are a proved sufficient
    time between changes, None without one or if any changes are allowed. `sequence` and `growth` are those of
    the family of motions that grows most, empty without one. `assumed` are the parts that start at the mean
    of the other peers in this analysis, but at their start values in a simulation (`joining: start`).
    """

    shown_by = "apc.extensions.changing_counts.changing_counts_output:changing_counts"

    topology: str
    parameter: str
    counts: tuple[int, ...]
    frame_s: float
    verdict: ChangeVerdict
    dwell_frames: int | None
    sequence: tuple[int, ...]
    growth: float
    families: tuple[MotionFamily, ...]
    linearized: bool
    lossy: bool
    assumed: tuple[str, ...] = ()

    @property
    def dwell_s(self) -> float | None:
        """The sufficient time between changes in seconds."""
        return None if self.dwell_frames is None else self.dwell_frames * self.frame_s


@part("changing counts")
def changing_counts(numeric: NumericModel, text: str, *, lossy: bool = False) -> ChangingCounts:
    """Return the stability of a model while peers of one group join and leave.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    text
        The number of peers and its values: `user.count=2:10`, or `user.count=2, 4`.
    lossy
        Whether links lose or delay packets, which is left out.

    Raises
    ------
    ApcError
        E881 invalid values; E890 a parameter that is no number of peers, too many counts or states, or peers
        that are not interchangeable.
    """
    name, _, values = text.partition("=")
    parameter_ref, counts = _counts(numeric, name.strip(), values)
    with single_threaded(), np.errstate(all="ignore"):
        families = _matrices(numeric, parameter_ref, counts)
        results = tuple(_motion_family(name, counts, matrices) for name, matrices in families.items())
    growing = max(results, key=lambda family: family.growth)
    dwells = [family.dwell_frames for family in results]
    dwell = None if None in dwells else max(frames for frames in dwells if frames is not None)
    verdict = (
        ChangeVerdict.ARBITRARY
        if all(family.common for family in results)
        else ChangeVerdict.UNSTABLE
        if growing.sequence
        else ChangeVerdict.DWELL
        if dwell is not None
        else ChangeVerdict.UNDECIDED
    )
    return ChangingCounts(
        topology=numeric.model.name,
        parameter=parameter_ref.label,
        counts=counts,
        frame_s=float(numeric.schedules[0].frame_s),
        verdict=verdict,
        dwell_frames=None if verdict is ChangeVerdict.ARBITRARY else dwell,
        sequence=growing.sequence,
        growth=growing.growth,
        families=results,
        linearized=not numeric.affine,
        lossy=lossy,
        assumed=_parts_at_start(numeric.model),
    )


def _parts_at_start(model: Model) -> tuple[str, ...]:
    """Return the parts with states or stored values that are not means at a joining peer."""
    return tuple(
        dict.fromkeys(
            name.partition(".")[0]
            for peer_type in model.peer_types
            for name in stored_names(peer_type)
            if not peer_type.joins_at_mean(name)
        )
    )


def _counts(numeric: NumericModel, name: str, values: str) -> tuple[ParameterRef, tuple[int, ...]]:
    """Return the number of peers that changes, and its values in rising order."""
    model = numeric.model
    names = [group_count(group.name) for group in model.groups]
    fix = f'--changing "{names[0]}=2:10"'
    if not values.strip():
        got = name or "nothing"
        raise ApcError(Diagnostic("E890", LOCATION, "changing count", "NAME=LOW:HIGH", got, fix))
    try:
        if find(model, name, LOCATION, counts=True).name not in names:
            expected = f"the number of peers of a group ({', '.join(names)})"
            raise ApcError(Diagnostic("E890", LOCATION, "changing count", expected, name, fix))
        axis = parse_axis(model, name, values)
        if len(axis.values) > MOST_COUNTS:
            least, expected = min(axis.values), f"at most {MOST_COUNTS} counts"
            got, fewer = str(len(axis.values)), f"{axis.free.name}={least}:{least + MOST_COUNTS - 1}"
            raise ApcError(Diagnostic("E890", LOCATION, axis.free.label, expected, got, fewer))
        for count in axis.values:
            apply(model, [Override(axis.free, count)])
    except ApcError as error:
        if error.mistakes[0].code == "E883":  # more values than any study has
            expected = f"at most {MOST_COUNTS} counts"
            raise ApcError(Diagnostic("E890", LOCATION, name, expected, values[:80], fix)) from None
        raise _located(error, names, values, fix) from None
    return axis.free, tuple(sorted(map(int, axis.values)))


def _located(error: ApcError, names: Sequence[str], values: str, fix: str) -> ApcError:
    """Return an error located at `--changing`, each fix with the option.

    `names` are the possible parameters, `values` the given values; `fix` replaces a fix of another form.
    """

    def pasted(proposed: str) -> str:
        """Return a fix as it is pasted."""
        name, _, proposed_values = proposed.partition("=")
        return f'--changing "{name}={proposed_values or values.strip()}"' if name in names else fix

    return ApcError(
        replace(mistake, location=LOCATION, fix=pasted(mistake.fix) if mistake.fix else "")
        for mistake in error.mistakes
    )


def _matrices(
    numeric: NumericModel, parameter_ref: ParameterRef, counts: Sequence[int]
) -> dict[str, dict[int, Matrix]]:
    """Return the frame matrices (2, n, n) of each family of motions, without rigid modes, by count.

    A family is absent where it has no motion: one peer has no difference.
    """
    families: dict[str, dict[int, Matrix]] = {}
    rigid: dict[str, tuple[object, ...]] = {}
    for count in counts:
        changed = numeric.at(apply(numeric.model, [Override(parameter_ref, Fraction(count))]))
        if sides(changed)[0].numeric is not changed:
            raise _not_interchangeable(f"with {count} peers the start is at a kink")
        peer_classes, comm_graph = lifted_classes(changed)
        complete = all(map(comm_graph.is_complete, comm_graph.links))
        if not complete or decompose(peer_classes, comm_graph).method != "modes":
            raise _not_interchangeable("the peers are not interchangeable")
        for closed in split(peer_classes, comm_graph):
            structure = loop_structure(closed)
            matrix = relative(
                with_error_radius(closed.matrix, closed.error),
                with_uncertainty(structure.relative),
                MIDPOINT_RADIUS,
            )
            key = (structure.rigid.names, structure.rigid.exact, matrix.shape, closed.names)
            if rigid.setdefault(closed.name, key) != key:
                raise _not_interchangeable(f"the states or rigid modes of {closed.name} depend on the number")
            families.setdefault(closed.name, {})[count] = matrix
    sizes = {name: next(iter(matrices.values())).shape[-1] for name, matrices in families.items()}
    largest = max(sizes.values())
    if largest > MOST_STATES:
        message = f"{largest} states of one family of motions, the limit is {MOST_STATES}"
        raise ApcError(Diagnostic("E890", LOCATION, message, advice="shorten the delays or the frame"))
    return families


def _not_interchangeable(reason: str) -> ApcError:
    """Return the error E890 for peers whose joins and leaves are not treated."""
    advice = "changes are analyzed for equal peers that all receive each other"
    return ApcError(Diagnostic("E890", LOCATION, reason, advice=advice))


def _motion_family(name: str, counts: Sequence[int], matrices: dict[int, Matrix]) -> MotionFamily:
    """Return the proofs for one family of motions, from its matrices (2, n, n) by count."""
    present = [count for count in counts if count in matrices]
    bounded = [matrices[count] for count in present]
    states = bounded[0].shape[-1]
    if not states:
        return MotionFamily(name, 0, True, 1, (), 0.0)
    scaled = balanced(bounded)
    if has_common_function(scaled):
        return MotionFamily(name, states, True, 1, (), 0.0)
    sequence, growth = _growing_sequence(scaled)
    unstable = tuple(present[index] for index in sequence)
    dwell = None if len(unstable) == 1 else _dwell_frames(scaled)
    return MotionFamily(name, states, False, dwell, unstable, growth)


def _dwell_frames(matrices: Sequence[Matrix]) -> int | None:
    """Return a number of frames between changes that is proved to suffice; None without one.

    If k frames suffice, so do more: doubling and bisection find the least k for the functions P_N with
    P_N − M_Nᵀ P_N M_N = I.
    """
    lyapunov = load_pool("scipy.linalg").solve_discrete_lyapunov
    functions = [lyapunov(value_of(matrix).T, np.eye(matrix.shape[-1])) for matrix in matrices]
    functions = [(function + function.T) / 2 for function in functions]
    pairs = list(zip(functions, matrices, strict=True))
    if not all(is_positive(MIDPOINT_RADIUS.exact(function)) for function in functions) or not all(
        decreases(function, matrix, function) for function, matrix in pairs
    ):
        return None

    def suffices(frames: int) -> bool:
        """Return whether a number of frames between changes is proved to suffice."""
        powers = [_power(matrix, frames) for matrix in matrices]
        return all(
            decreases(before, power, after)
            for (before, power), after in itertools.product(zip(functions, powers, strict=True), functions)
        )

    high = 1
    while not suffices(high):
        high *= 2
        if high > MOST_FRAMES:
            return None
    low = high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if suffices(middle) else (middle, high)
    return high


def _power(matrix: Matrix, exponent: int) -> Matrix:
    """Return a power of a matrix (2, n, n) with its error bound."""
    result = MIDPOINT_RADIUS.exact(np.eye(matrix.shape[-1]))
    while exponent:
        if exponent % 2:
            result = MIDPOINT_RADIUS.multiply(result, matrix)
        matrix, exponent = MIDPOINT_RADIUS.multiply(matrix, matrix), exponent // 2
    return result


def _growing_sequence(matrices: Sequence[Matrix]) -> tuple[tuple[int, ...], float]:
    """Return the indices of matrices whose repeated product grows most, and its growth per frame.

    Growth is proved; the sequence is empty without a product that grows.
    """
    best, growth = (), 1.0
    for indices, products in _products([value_of(matrix) for matrix in matrices]):
        mean = largest_magnitudes(products) ** (1 / indices.shape[1])
        largest = int(np.argmax(mean))
        if not mean[largest] > growth * (1 + CLEARLY):
            continue
        sequence = tuple(indices[largest].tolist())
        product = MIDPOINT_RADIUS.exact(np.eye(products.shape[-1]))
        for index in sequence:
            product = MIDPOINT_RADIUS.multiply(matrices[index], product)
        if enclose_eigenvalues(value_of(product), error_radius(product))[1].low > 1:
            best, growth = sequence, float(mean[largest])
        if len(best) == 1:  # with this number of peers the model is unstable without changes
            break
    return best, growth if best else 0.0


def _products(steps: Sequence[Floats]) -> Iterator[tuple[NDArray[np.intp], Floats]]:
    """Yield the index sequences (k, length) of each length, with their products (k, n, n).

    All matrices are multiplied as long as there are at most MOST_PRODUCTS products, then a few of them.
    """
    chosen = np.unique(np.linspace(0, len(steps) - 1, min(len(steps), MOST_FACTORS)).astype(np.intp))
    for length in range(1, LONGEST + 1):
        while len(chosen) ** length > MOST_PRODUCTS:
            chosen = chosen[[0, -1]] if len(chosen) <= 3 else np.delete(chosen, len(chosen) // 2)
        indices = np.array(list(itertools.product(chosen.tolist(), repeat=length)))
        stack = np.array(steps)
        products = stack[indices[:, 0]]
        for column in range(1, length):
            products = stack[indices[:, column]] @ products
        yield indices, products
