"""The frame matrices of a model for many values of its parameters, with their derivatives.

Takes: peer classes whose subsystems are affine, the links between them, and the parameters that vary.
Gives: `MatrixSource`; `BatchEvaluator`, `batch_evaluator`; `Bounded`, `lifted_systems`, `is_too_large`.
Guarantees: shared data is built once for all values; rigid modes are removed by their exact directions; a
derivative is exact to rounding. A point with infinite matrices, or with other rigid modes than its
neighbours, has the value NaN.
Does not: choose the classes (see `evaluator`), or compute eigenvalues.

Derivatives are complex steps, M′ = Im M(p + i h p′)/h, without cancellation for any small h (Squire and
Trapp, SIAM Review 40, 1998), through the composition of the frame; CasADi differentiates the coefficients.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol, TypeVar

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.lifting.discretize import exponential
from apc.lifting.interval_arithmetic import FLOATS, MIDPOINT_RADIUS, Arithmetic, error_radius, value_of
from apc.lifting.lift import FrameMap, compose, lift, with_roundings
from apc.linearization.jacobians import SubsystemJacobians
from apc.linearization.linear_subsystem import LinearSubsystem, every_matrix
from apc.linearization.linearize import linearize, linearize_exact, linearize_rows, of_rows, subsystem_of
from apc.parameter_values.parameter_names import ParameterRef, value_now
from apc.parameter_values.parameters import free_rows
from apc.spectrum.interconnection import ClosedLoop, ModalSystem, close_loop, interconnect
from apc.spectrum.modes import split
from apc.spectrum.peer_classes import PeerClass
from apc.spectrum.relative_coordinates import relative, with_uncertainty
from apc.spectrum.rigid_modes import find_rigid_modes
from apc.studies.loop_structure import (
    LoopStructure,
    are_rigid,
    closed_loop,
    loop_structure,
    reduced,
    relative_at,
    with_constant_pivots,
)
from apc.timing.communication_graph import CommunicationGraph
from apc.timing.schedule import Propagate

Floats = NDArray[np.float64]
Matrices = NDArray[Any]  # float64 or complex128
Wired = TypeVar("Wired", ClosedLoop, ModalSystem)

# The complex step: its square is negligible relative to 1, for any size of the parameter.
STEP = 1e-60

# The values at which the dependence of entries on free parameters is tested: arbitrary and all different, as
# is the direction. (At equal values, along a common direction, a ratio such as k/m is constant.)
GENERIC_POINT = 0.7390851332151607
GENERIC_RATIO = 0.6180339887498949


# A step shorter than this share of the delays that form it as a difference is zero.
VANISHING = 1e-14

# Rates beyond this, in 1/s, are not exponentiated: they come from a mass of 0, or nearly 0.
LARGEST = 1e15


class MatrixSource(Protocol):
    """The protocol of a source of matrices over some parameters, whose largest eigenvalue is the
    criterion.
    """

    @property
    def model(self) -> Model:
        """The compiled model."""

    @property
    def free(self) -> tuple[ParameterRef, ...]:
        """The m parameters that vary, in the order of the columns of values."""

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return each system's reduced frame matrices (k, n, n) at values (k, m)."""

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return each system's matrices (k, n, n) and their derivatives along directions (k, m)."""


@dataclass(frozen=True, slots=True, eq=False)
class Bounded:
    """A closed system at k points, with error bounds.

    `matrix` is that in relative coordinates, NaN where the removed modes are not rigid, and `error` bounds
    its error; `frame_map` is the matrix of the complete state, `received` are the received values of each
    subsystem as functions of it.
    """

    matrix: Floats  # (k, m, m)
    error: Floats  # (k, m, m)
    frame_map: Floats  # (k, n, n)
    received: tuple[Floats, ...]  # (n_r, n) or (k, n_r, n), one per subsystem
    subsystems: tuple[LinearSubsystem, ...]

    def at(self, indices: NDArray[np.intp]) -> Bounded:
        """Return the system at some of the points, given by increasing indices."""
        if len(indices) == len(self.matrix):  # all of them
            return self

        def select(matrix: Matrices) -> Matrices:
            """Return the entries of these points, or a constant matrix unchanged."""
            return matrix if matrix.ndim == 2 or len(matrix) == 1 else matrix[indices]

        return Bounded(
            matrix=select(self.matrix),
            error=select(self.error),
            frame_map=select(self.frame_map),
            received=tuple(map(select, self.received)),
            subsystems=tuple(every_matrix(subsystem, select) for subsystem in self.subsystems),
        )


@dataclass(frozen=True, slots=True, eq=False)
class BatchEvaluator:
    """A `MatrixSource` of a model whose matrices are functions of its parameters in closed form.

    `wirings` are the loop structures of the closed systems. `durations` are the seconds of each step by its
    quanta, as (constant, slope): the slope is with respect to the only free value if it is a time. `tangents`
    are the coefficients of each peer type with their derivatives, empty for a time that affects no
    coefficient; `fixed` are the exponentials of the classes that do not depend on free parameters.
    """

    model: Model
    free: tuple[ParameterRef, ...]
    comm_graph: CommunicationGraph
    peer_classes: tuple[PeerClass, ...]
    wirings: tuple[LoopStructure, ...]
    durations: Mapping[int, tuple[float, float]]
    tangents: Mapping[str, Any]  # casadi.Function by the peer type's name
    fixed: Mapping[int, Mapping[int, Matrices]]  # exponentials independent of free parameters

    @property
    def closed(self) -> tuple[ClosedLoop, ...]:
        """The closed systems at a generic point."""
        return tuple(wiring.closed_loop for wiring in self.wirings)

    @property
    def timed(self) -> bool:
        """Whether the free parameter is a time."""
        return any(slope for _, slope in self.durations.values())

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return each system's reduced frame matrices (k, n, n) at values (k, m)."""
        lifted = self.lifted(values)
        return tuple(reduced(wiring, closed_loop(wiring, lifted), len(values)) for wiring in self.wirings)

    def states(self) -> int:
        """Return the number of states of the largest closed system."""
        return max((len(closed_system.matrix) for closed_system in self.closed), default=0)

    def errors(self, values: Floats) -> tuple[Floats, ...]:
        """Return bounds (k, n, n) on the errors of the matrices at values (k, m), entry by entry."""
        bounded_systems = self.bounded(partial(self.vectors, values=values))
        return tuple(
            np.broadcast_to(bounded.error, (len(values), *bounded.error.shape[1:]))
            for bounded in bounded_systems
        )

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return each system's matrices (k, n, n) and their derivatives along directions (k, m)."""
        lifted = self.lifted(values + (STEP * 1j) * along)
        matrices = (reduced(wiring, closed_loop(wiring, lifted), len(values)) for wiring in self.wirings)
        # Squares of the step appear at zeros: balancing would take them for entries.
        return tuple(
            (np.where(np.abs(stepped.real) <= STEP, 0.0, stepped.real), stepped.imag / STEP)
            for stepped in matrices
        )

    def vectors(self, peer_class: PeerClass, values: Matrices) -> Matrices:
        """Return the parameter vectors (k, n_p) of a class, or (1, n_p) if they are constant."""
        if not self.tangents:
            return peer_class.parameters[None]
        index, peer = self.first_peer(peer_class)
        values_of = {parameter_ref: values[:, column] for column, parameter_ref in enumerate(self.free)}
        return free_rows(self.model, self.model.groups[index], peer, values_of)

    def first_peer(self, peer_class: PeerClass) -> tuple[int, int]:
        """Return the index of the model's group of the first peer of a class, and the peer's index in
        the group.
        """
        first = peer_class.peers.first
        index = self.comm_graph.group_of(first)
        return index, first - int(self.comm_graph.starts[index])

    def closed_at(self, value: Sequence[float]) -> tuple[ClosedLoop, ...]:
        """Return the closed systems at one point (m,), as in an analysis: with error bounds."""
        assert not self.timed, "another time is another schedule"
        return tuple(map(close_loop, lifted_systems(self.with_subsystems(self.closed, value))))

    def with_subsystems(self, systems: Sequence[Wired], value: Sequence[float]) -> tuple[Wired, ...]:
        """Return systems with the exact subsystems of one point (m,).

        If the parameter is a time, only step durations change.
        """
        used = {peer_class.index for closed_loop in systems for peer_class in closed_loop.peer_classes}
        at_value = {
            peer_class.index: (vector, linearize_exact(peer_class.jacobians, peer_class.exact_at(vector)))
            for peer_class, vector in self._parameters_at(value)
            if peer_class.index in used
        }

        def at_point(peer_class: PeerClass) -> PeerClass:
            """Return a class with the parameters and the exact subsystem of the point."""
            vector, exact = at_value[peer_class.index]
            numbers = tuple(peer_class.exact_at(vector))
            return replace(peer_class, parameters=vector, exact_parameters=numbers, exact=exact)

        return tuple(
            replace(closed_loop, peer_classes=tuple(map(at_point, closed_loop.peer_classes)))
            for closed_loop in systems
        )

    def _parameters_at(self, value: Sequence[float]) -> list[tuple[PeerClass, Floats]]:
        """Return each class with its parameters at one point (m,)."""
        point = np.array([value], dtype=np.float64)
        return [(peer_class, self.vectors(peer_class, point)[0]) for peer_class in self.peer_classes]

    def lifted(self, values: Matrices) -> dict[int, FrameMap]:
        """Return the frame maps of all classes by their indices."""
        result: dict[int, FrameMap] = {}
        for peer_class in self.peer_classes:
            if peer_class.index not in result:
                result[peer_class.index] = self._lift(peer_class, values)
        return result

    def bounded(self, vectors: Callable[[PeerClass], Floats]) -> tuple[Bounded, ...]:
        """Return each system at k points with bounds on all its errors; the varied parameters are no times.

        Parameters
        ----------
        vectors
            The function from a class to its parameters at each point (k, n_p), or (1, n_p) if constant.
        """
        assert not self.timed, "the errors of a step belong to its time"
        lifts: dict[int, tuple[LinearSubsystem, FrameMap]] = {}
        for peer_class in self.peer_classes:
            if peer_class.index not in lifts:
                lifts[peer_class.index] = self._lift_bounded(peer_class, vectors(peer_class))
        bounded_systems = []
        for wiring in self.wirings:
            closed_loop = wiring.closed_loop
            subsystems, maps = zip(
                *(lifts[peer_class.index] for peer_class in closed_loop.peer_classes), strict=True
            )
            closed = interconnect(maps, wiring.feedback, closed_loop.layout, numbers=MIDPOINT_RADIUS)
            complete = value_of(closed.matrix)
            coordinates, is_valid = relative_at(wiring, complete)
            relative_matrix = relative(closed.matrix, with_uncertainty(coordinates), MIDPOINT_RADIUS)
            matrix, error = value_of(relative_matrix), error_radius(relative_matrix)
            is_valid = is_valid & np.isfinite(error.sum(axis=(1, 2)))
            if not is_valid.all():
                matrix = np.where(is_valid[:, None, None], matrix, np.nan)
            bounded_systems.append(
                Bounded(matrix, error, complete, tuple(map(value_of, closed.received)), subsystems)
            )
        return tuple(bounded_systems)

    def _lift_bounded(self, peer_class: PeerClass, vectors: Floats) -> tuple[LinearSubsystem, FrameMap]:
        """Return the subsystems of a class at all points, and their frame maps with error radii."""
        rows = linearize_rows(peer_class.jacobians, vectors)
        subsystem, steps, invalid = self._with_exponentials(
            peer_class, subsystem_of(peer_class.jacobians, rows)
        )
        bounded = with_roundings(subsystem)
        steps = steps or self.steps(bounded, np.zeros((1, 1)), MIDPOINT_RADIUS)
        with np.errstate(all="ignore"):
            frame = compose(bounded, peer_class.schedule, steps, numbers=MIDPOINT_RADIUS)
        _set_invalid(frame, invalid)
        return subsystem, frame

    def _lift(self, peer_class: PeerClass, values: Matrices) -> FrameMap:
        """Return the frame map of a class, each matrix with a leading axis of points; NaN at invalid
        points.
        """
        if self.tangents:
            rows = self.rows(peer_class.jacobians, self.vectors(peer_class, values))
            linear_subsystem = subsystem_of(peer_class.jacobians, rows)
        else:
            linear_subsystem = every_matrix(peer_class.subsystem, lambda block: np.array(block[None]))
        subsystem, exponentials, invalid = self._with_exponentials(peer_class, linear_subsystem)
        transitions = {quanta: value_of(step) for quanta, step in exponentials.items()}
        transitions = transitions or self.steps(subsystem, values, FLOATS)
        with np.errstate(all="ignore"):
            frame = compose(subsystem, peer_class.schedule, transitions)
        _set_invalid(frame, invalid)
        return frame

    def _with_exponentials(
        self, peer_class: PeerClass, subsystem: LinearSubsystem
    ) -> tuple[LinearSubsystem, Mapping[int, Matrices], NDArray[np.bool_]]:
        """Return a class's subsystems, their exponentials if constant, and the mask of points without
        exponentials.
        """
        too_large = is_too_large(subsystem.a, subsystem.b)
        if peer_class.index in self.fixed:
            return (
                replace(subsystem, a=subsystem.a[:1], b=subsystem.b[:1]),
                self.fixed[peer_class.index],
                too_large,
            )
        subsystem.a[too_large], subsystem.b[too_large] = (
            0.0,
            0.0,
        )  # infinite entries would also affect other points
        return subsystem, {}, too_large

    def steps(
        self, subsystem: LinearSubsystem, values: Matrices, arithmetic: Arithmetic
    ) -> dict[int, Matrices]:
        """Return the exponentials of every step by its quanta, for all points, or for one if they are
        constant.
        """
        a, b = _simplified(subsystem.a, subsystem.b)
        steps = {}
        for quanta, (constant, slope) in self.durations.items():
            seconds: float | Matrices = constant
            if slope:
                seconds = constant + slope * values[:, 0, None, None]
                # The remainder of a vanishing step is rounding, which would perturb the eigenvectors.
                vanishes = np.abs(seconds) < VANISHING * abs(constant)
                seconds = np.where(vanishes, seconds - seconds.real, seconds)
            with np.errstate(all="ignore"):
                steps[quanta] = exponential(a, b, seconds, arithmetic)
        return steps

    def rows(self, built: SubsystemJacobians, vectors: Matrices) -> Matrices:
        """Return the coefficients (k, …) of subsystems with these parameters.

        For parameters with a complex step, the imaginary parts are the derivatives times the step.
        """
        if not np.iscomplexobj(vectors):
            return linearize_rows(built, vectors)
        value, slope = of_rows(self.tangents[built.peer_type.name], {0: vectors.real, 1: vectors.imag / STEP})
        return value + (STEP * 1j) * slope


def batch_evaluator(
    model: Model,
    parameter_refs: Sequence[ParameterRef],
    peer_classes: Sequence[PeerClass],
    comm_graph: CommunicationGraph,
    *,
    durations: Mapping[int, tuple[float, float]] | None = None,
    follows: bool = True,
    matrices: bool = True,
) -> BatchEvaluator:
    """Return an evaluator of classes of peers for many values of some parameters.

    Parameters
    ----------
    model
        The compiled model.
    parameter_refs
        The parameters that vary.
    peer_classes, comm_graph
        The model's peers at a generic point, from `analysis.lifted_classes`.
    durations
        For a time that varies: the seconds of each step by its quanta, as constant and slope.
    follows
        Whether any coefficient may depend on the varied parameters.
    matrices
        Whether the systems' matrices are required, or only the maps of the subsystems.
    """
    systems = split(peer_classes, comm_graph) if matrices else ()
    if durations is None:
        durations = {
            event.duration: (float(event.duration * peer_class.schedule.quantum), 0.0)
            for peer_class in peer_classes
            for event in peer_class.schedule.events
            if isinstance(event, Propagate)
        }
    tangents = (
        {peer_class.jacobians.peer_type.name: _tangent(peer_class.jacobians) for peer_class in peer_classes}
        if follows
        else {}
    )
    evaluator = BatchEvaluator(
        model=model,
        free=tuple(parameter_refs),
        comm_graph=comm_graph,
        peer_classes=tuple(peer_classes),
        wirings=tuple(loop_structure(closed_system) for closed_system in systems),
        durations=durations,
        tangents=tangents,
        fixed={},
    )
    evaluator = replace(evaluator, fixed=_constant_exponentials(evaluator))
    return replace(evaluator, wirings=_marked_structures(evaluator)) if follows else evaluator


def _marked_structures(evaluator: BatchEvaluator) -> tuple[LoopStructure, ...]:
    """Return the loop structures, with rigid directions that depend on parameters marked as such."""
    if not any(wiring.rigid.names for wiring in evaluator.wirings):
        return evaluator.wirings
    base = np.array([value_now(evaluator.model, parameter_ref) for parameter_ref in evaluator.free])
    other_point = (base * (1 + _generic_point(len(base))[0][0]) + 1e-3).tolist()
    lifted = evaluator.lifted(np.array([other_point]))
    wirings = []
    for index, wiring in enumerate(evaluator.wirings):
        matrix = closed_loop(wiring, lifted)
        directions_move = bool(np.isfinite(matrix).all() and not are_rigid(wiring, matrix).all())
        if directions_move and not wiring.rigid.drifts:
            rigid_elsewhere = find_rigid_modes(
                evaluator.with_subsystems(evaluator.closed, other_point)[index], with_drifts=False
            )
            wirings.append(with_constant_pivots(wiring, rigid_elsewhere))
        else:
            wirings.append(wiring)
    return tuple(wirings)


def _generic_point(count: int) -> tuple[Floats, Floats]:
    """Return a generic point (1, count) and a direction, with all ratios different."""
    indices = 1.0 + np.arange(count)
    return 0.5 + np.mod(GENERIC_POINT * indices, 1.0)[None], 0.5 + np.mod(GENERIC_RATIO * indices, 1.0)[None]


def _constant_exponentials(evaluator: BatchEvaluator) -> dict[int, Mapping[int, Matrices]]:
    """Return the exponentials of the classes whose A and B no free parameter affects."""
    if evaluator.timed:
        return {}
    result: dict[int, Mapping[int, Matrices]] = {}
    point, along = _generic_point(len(evaluator.free))
    for peer_class in evaluator.peer_classes:
        if peer_class.index in result:
            continue
        vectors = evaluator.vectors(peer_class, point + (STEP * 1j) * along)
        subsystem = subsystem_of(peer_class.jacobians, evaluator.rows(peer_class.jacobians, vectors))
        if not (np.iscomplexobj(subsystem.a) and (subsystem.a.imag.any() or subsystem.b.imag.any())):
            real = with_roundings(every_matrix(subsystem, np.real))
            result[peer_class.index] = evaluator.steps(real, point, MIDPOINT_RADIUS)
    return result


def lifted_systems(systems: Sequence[Wired]) -> tuple[Wired, ...]:
    """Return systems with their subsystems linearized and lifted at their parameters, each subsystem once."""
    cached: dict[int, tuple[LinearSubsystem, FrameMap]] = {}

    def lifted(peer_class: PeerClass) -> PeerClass:
        """Return a class with its subsystem and frame map at its parameters."""
        key, built = peer_class.index, peer_class.jacobians
        if key not in cached:
            subsystem = linearize(built, peer_class.parameters)
            cached[key] = subsystem, lift(subsystem, peer_class.schedule, exact=peer_class.exact)
        subsystem, frame = cached[key]
        return replace(peer_class, subsystem=subsystem).with_lifted(frame)

    return tuple(
        replace(closed_loop, peer_classes=tuple(map(lifted, closed_loop.peer_classes)))
        for closed_loop in systems
    )


def is_too_large(a: Matrices, b: Matrices) -> NDArray[np.bool_]:
    """Return the mask of the A and B that are too large, or not finite, for an exponential in floats."""
    size = np.abs(a).sum(axis=(1, 2)) + np.abs(b).sum(axis=(1, 2))
    too_large: NDArray[np.bool_] = ~(size < LARGEST)
    return too_large


def _set_invalid(frame: FrameMap, invalid: NDArray[np.bool_]) -> None:
    """Set the frame maps of points without exponentials to NaN."""
    rows = invalid if len(invalid) == len(frame.p) else slice(0, len(frame.p) if invalid.any() else 0)
    frame.p[rows] = frame.q[rows] = np.nan


def _simplified(a: Matrices, b: Matrices) -> tuple[Matrices, Matrices]:
    """Return A and B of one point if they are constant, and real ones if they have no derivative."""
    if len(a) > 1 and (a == a[:1]).all() and (b == b[:1]).all():
        a, b = a[:1], b[:1]
    if np.iscomplexobj(a) and not (a.imag.any() or b.imag.any()):
        a, b = a.real.copy(), b.real.copy()
    return a, b


def _tangent(built: SubsystemJacobians) -> Any:
    """Return the function of parameters p and a direction dp to the matrices' coefficients and their
    derivative along dp.

    The subsystem is affine: the function's other arguments are taken as zero.
    """
    arguments = built.function.sx_in()  # (x, u, m, r, p, t)
    direction = casadi.SX.sym("along", arguments[4].numel())
    zeros = [casadi.SX.zeros(argument.numel()) for argument in arguments]
    (coefficients,) = built.function.call([*zeros[:4], arguments[4], zeros[5]])
    derivative = casadi.jtimes(coefficients, arguments[4], direction)
    return casadi.Function(
        "tangent", [arguments[4], direction], [casadi.densify(coefficients), casadi.densify(derivative)]
    )
