"""The frame matrices of a system for many values of its parameters at once, with their derivatives.

Takes: groups of peers whose sites are affine, the exchange between them, and the parameters that vary.
Gives: `MatrixSource`; `BatchEvaluator`, `batch_evaluator`; `lifted_systems`, `relative_here`,
`inverse_size`, `is_beyond`.
Guarantees: what is built once serves every value; rigid motions are taken out by their exact directions; a
derivative is exact to rounding. A point whose matrices are not finite, or that has other rigid motions than
its neighbours, comes out as NaN, never as a wrong number.
Does not: choose the groups (see `evaluator`), or compute eigenvalues.

Derivatives go by the complex step, M′ = Im M(p + i h p′)/h, which cancels nothing however small h (Squire and
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
from apc.eigen.closing import ClosedLoop, ModalSystem, close, close_loop
from apc.eigen.modes import split
from apc.eigen.peers import PeerClass
from apc.eigen.relative import relative, with_doubt
from apc.eigen.rigid import find_rigid_modes
from apc.frame.discretize import exponential
from apc.frame.exchange import CommunicationGraph
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.lift import FrameMap, compose, lift, with_roundings
from apc.frame.linearize import linearize, linearize_exact, linearize_rows, of_rows, site_of
from apc.frame.names import ParameterRef, value_now
from apc.frame.parameters import free_rows
from apc.frame.radius import FLOATS, RADII, Arithmetic, radius_of, value_of
from apc.frame.schedule import Propagate
from apc.frame.site import LinearSubsystem, every_matrix
from apc.vary.wiring import (
    LoopStructure,
    are_rigid,
    closed_loop,
    known_by_constants,
    reduced,
    relative_at,
    site_key,
    wire,
)

Floats = NDArray[np.float64]
Matrices = NDArray[Any]  # float64 or complex128
Wired = TypeVar("Wired", ClosedLoop, ModalSystem)
T = TypeVar("T")

# The complex step: its square vanishes beside 1, whatever the parameter's size.
STEP = 1e-60

# Where it is looked whether a free parameter moves an entry: at values of no meaning, each another, a
# derivative along as meaningless a direction that vanishes does so everywhere. (At one value for all, along a
# direction that moves all alike, a ratio such as k/m stays.)
GENERIC_POINT = 0.7390851332151607
GENERIC_RATIO = 0.6180339887498949


# A step shorter than this share of the delays it is the difference of is none.
VANISHING = 1e-14

# Rates beyond this, in 1/s or what stands for it, are not exponentiated: of a mass of 0, or next to it.
LARGEST = 1e15


class MatrixSource(Protocol):
    """Matrices of which the largest eigenvalue decides, over values of some parameters."""

    @property
    def system(self) -> Model:
        """The compiled scene."""

    @property
    def free(self) -> tuple[ParameterRef, ...]:
        """The m parameters that vary, in the order of the columns of values."""

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return each system's reduced frame matrices (k, n, n) at values (k, m)."""

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return each system's matrices (k, n, n) and their derivatives along directions (k, m)."""


@dataclass(frozen=True, slots=True, eq=False)
class Bounded:
    """A closed system at k points.

    `matrix` is that of relative coordinates, NaN where the motions taken out are not rigid, and `error`
    bounds what it is off by; `whole` is that of the whole state, `heard` what each site hears over it.
    """

    matrix: Floats  # (k, m, m)
    error: Floats  # (k, m, m)
    whole: Floats  # (k, n, n)
    heard: tuple[Floats, ...]  # (n_r, n) or (k, n_r, n), one a site
    sites: tuple[LinearSubsystem, ...]

    def at(self, places: NDArray[np.intp]) -> Bounded:
        """Return some of the points, places in rising order."""
        if len(places) == len(self.matrix):  # all of them
            return self

        def some(matrix: Matrices) -> Matrices:
            return matrix if matrix.ndim == 2 or len(matrix) == 1 else matrix[places]

        return Bounded(
            matrix=some(self.matrix),
            error=some(self.error),
            whole=some(self.whole),
            heard=tuple(map(some, self.heard)),
            sites=tuple(every_matrix(site, some) for site in self.sites),
        )


@dataclass(frozen=True, slots=True, eq=False)
class BatchEvaluator:
    """A `MatrixSource` of a scene whose matrices follow from its parameters in closed form.

    `durations` are the seconds of each step by its quanta, as (constant, slope), the slope over the only free
    value where that is a time. `tangents` are the coefficients of each kind with their derivatives, none
    where a time varies that stands in no coefficient; `fixed` the exponentials of the groups where nothing
    free reaches them.
    """

    system: Model
    free: tuple[ParameterRef, ...]
    exchange: CommunicationGraph
    groups: tuple[PeerClass, ...]
    wirings: tuple[LoopStructure, ...]
    durations: Mapping[int, tuple[float, float]]
    tangents: Mapping[str, Any]  # casadi.Function by the kind's name
    fixed: Mapping[tuple[int, int], Mapping[int, Matrices]]  # exponentials that nothing free reaches

    @property
    def closed(self) -> tuple[ClosedLoop, ...]:
        """The closed systems at a point that stands for all."""
        return tuple(wiring.system for wiring in self.wirings)

    @property
    def timed(self) -> bool:
        """Whether it is a time that varies."""
        return any(slope for _, slope in self.durations.values())

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return each system's reduced frame matrices (k, n, n) at values (k, m)."""
        lifted = self.lifted(values)
        return tuple(reduced(wiring, closed_loop(wiring, lifted), len(values)) for wiring in self.wirings)

    def states(self) -> int:
        """Return how many states the largest closed system has."""
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
        # Squares of the step stand where nothing should: balancing would take them for entries.
        return tuple(
            (np.where(np.abs(values.real) <= STEP, 0.0, values.real), values.imag / STEP)
            for values in matrices
        )

    def vectors(self, group: PeerClass, values: Matrices) -> Matrices:
        """Return the parameter vectors (k, n_p) of a group, or (1, n_p) when no value reaches it."""
        if not self.tangents:
            return group.parameters[None]
        place, peer = self.first_peer(group)
        listed = {free: values[:, column] for column, free in enumerate(self.free)}
        return free_rows(self.system, self.system.groups[place], peer, listed)

    def first_peer(self, group: PeerClass) -> tuple[int, int]:
        """Return which group of the scene the first of a group of like peers is of, and its number there."""
        first = group.peers.first
        place = self.exchange.group_of(first)
        return place, first - int(self.exchange.starts[place])

    def closed_at(self, value: Sequence[float]) -> tuple[ClosedLoop, ...]:
        """Return the closed systems at one point (m,), as an analysis has them: with error bounds."""
        assert not self.timed, "another time is another schedule"
        return tuple(map(close_loop, lifted_systems(self.with_sites(self.closed, value))))

    def with_sites(self, systems: Sequence[Wired], value: Sequence[float]) -> tuple[Wired, ...]:
        """Return systems with the exact sites of one point (m,); of a time, all but the steps is of it."""
        used = {site_key(group) for system in systems for group in system.sites}
        moved = {
            site_key(group): (vector, linearize_exact(group.jacobians, vector))
            for group, vector in self._points(value)
            if site_key(group) in used
        }

        def at_point(group: PeerClass) -> PeerClass:
            vector, exact = moved[site_key(group)]
            return replace(group, parameters=vector, exacting=lambda: exact)

        return tuple(replace(system, sites=tuple(map(at_point, system.sites))) for system in systems)

    def _points(self, value: Sequence[float]) -> list[tuple[PeerClass, Floats]]:
        point = np.array([value], dtype=np.float64)
        return [(group, self.vectors(group, point)[0]) for group in self.groups]

    def lifted(self, values: Matrices) -> dict[tuple[int, int], FrameMap]:
        """Return the maps of all groups, each once, by the identity of site and schedule."""
        result: dict[tuple[int, int], FrameMap] = {}
        for group in self.groups:
            if site_key(group) not in result:
                result[site_key(group)] = self._lift(group, values)
        return result

    def bounded(self, vectors: Callable[[PeerClass], Floats]) -> tuple[Bounded, ...]:
        """Return each system at k points with bounds on all its errors; no time varies.

        Parameters
        ----------
        vectors
            Gives the parameters of a group at each point (k, n_p), or (1, n_p) where no value reaches it.
        """
        assert not self.timed, "the errors of a step belong to its time"
        lifts: dict[tuple[int, int], tuple[LinearSubsystem, FrameMap]] = {}
        for group in self.groups:
            if site_key(group) not in lifts:
                lifts[site_key(group)] = self._lift_bounded(group, vectors(group))
        bounded_systems = []
        for wiring in self.wirings:
            system = wiring.system
            sites, maps = zip(*(lifts[site_key(group)] for group in system.sites), strict=True)
            closed = close(maps, wiring.feedback, system.layout, numbers=RADII)
            whole = value_of(closed.matrix)
            at, sound = relative_at(wiring, whole)
            within = relative(closed.matrix, with_doubt(at), RADII)
            matrix, error = value_of(within), radius_of(within)
            sound = sound & np.isfinite(error.sum(axis=(1, 2)))
            if not sound.all():
                matrix = np.where(sound[:, None, None], matrix, np.nan)
            bounded_systems.append(Bounded(matrix, error, whole, tuple(map(value_of, closed.heard)), sites))
        return tuple(bounded_systems)

    def _lift_bounded(self, group: PeerClass, vectors: Floats) -> tuple[LinearSubsystem, FrameMap]:
        rows = linearize_rows(group.jacobians, vectors)
        site, steps, lost = self._placed(group, site_of(group.jacobians, rows))
        bounded = with_roundings(site)
        steps = steps or self.steps(bounded, np.zeros((1, 1)), RADII)
        with np.errstate(all="ignore"):
            frame = compose(bounded, group.schedule, steps, numbers=RADII)
        _lose(frame, lost)
        return site, frame

    def _lift(self, group: PeerClass, values: Matrices) -> FrameMap:
        if self.tangents:
            rows = self.rows(group.jacobians, self.vectors(group, values))
            linear_site = site_of(group.jacobians, rows)
        else:
            linear_site = every_matrix(group.site, lambda block: np.array(block[None]))
        site, fixed, lost = self._placed(group, linear_site)
        steps = {quanta: value_of(step) for quanta, step in fixed.items()}
        steps = steps or self.steps(site, values, FLOATS)
        with np.errstate(all="ignore"):
            frame = compose(site, group.schedule, steps)
        _lose(frame, lost)
        return frame

    def _placed(
        self, group: PeerClass, site: LinearSubsystem
    ) -> tuple[LinearSubsystem, Mapping[int, Matrices], NDArray[np.bool_]]:
        """Return a group's sites, their exponentials if nothing free reaches these, and which have none."""
        beyond = is_beyond(site.a, site.b)
        if site_key(group) in self.fixed:
            return replace(site, a=site.a[:1], b=site.b[:1]), self.fixed[site_key(group)], beyond
        site.a[beyond], site.b[beyond] = 0.0, 0.0  # they would spoil the others' exponentials
        return site, {}, beyond

    def steps(self, site: LinearSubsystem, values: Matrices, numbers: Arithmetic) -> dict[int, Matrices]:
        """Return the exponentials of every step, one for all points where A, B and the time stay."""
        a, b = _shared(site.a, site.b)
        steps = {}
        for quanta, (constant, slope) in self.durations.items():
            seconds: float | Matrices = constant
            if slope:
                seconds = constant + slope * values[:, 0, None, None]
                # What is left of a step that vanishes is rounding, which would upset the eigenvectors.
                gone = np.abs(seconds) < VANISHING * abs(constant)
                seconds = np.where(gone, seconds - seconds.real, seconds)
            with np.errstate(all="ignore"):
                steps[quanta] = exponential(a, b, seconds, numbers)
        return steps

    def rows(self, built: SubsystemJacobians, vectors: Matrices) -> Matrices:
        """Return the coefficients (k, …) of many sites; those of a complex step with their derivative."""
        if not np.iscomplexobj(vectors):
            return linearize_rows(built, vectors)
        value, slope = of_rows(self.tangents[built.kind.name], {0: vectors.real, 1: vectors.imag / STEP})
        return value + (STEP * 1j) * slope


def batch_evaluator(
    system: Model,
    free: Sequence[ParameterRef],
    groups: Sequence[PeerClass],
    exchange: CommunicationGraph,
    *,
    durations: Mapping[int, tuple[float, float]] | None = None,
    follows: bool = True,
    matrices: bool = True,
) -> BatchEvaluator:
    """Prepare groups of peers for many values of some parameters.

    Parameters
    ----------
    system
        The compiled scene.
    free
        The parameters that vary.
    groups, exchange
        The scene's peers at a point that stands for all, from `analysis.lifted_groups`.
    durations
        Where a time varies: the seconds of each step by its quanta, as constant and slope.
    follows
        Whether any coefficient may follow what varies.
    matrices
        Whether the systems' matrices are wanted, and not the maps of the sites alone.
    """
    systems = split(groups, exchange) if matrices else ()
    if durations is None:
        durations = {
            event.duration: (float(event.duration * group.schedule.quantum), 0.0)
            for group in groups
            for event in group.schedule.events
            if isinstance(event, Propagate)
        }
    tangents = {group.jacobians.kind.name: _tangent(group.jacobians) for group in groups} if follows else {}
    evaluator = BatchEvaluator(
        system=system,
        free=tuple(free),
        exchange=exchange,
        groups=tuple(groups),
        wirings=tuple(wire(system) for system in systems),
        durations=durations,
        tangents=tangents,
        fixed={},
    )
    evaluator = replace(evaluator, fixed=_fixed(evaluator))
    return replace(evaluator, wirings=_told_apart(evaluator)) if follows else evaluator


def _told_apart(evaluator: BatchEvaluator) -> tuple[LoopStructure, ...]:
    """Return the wirings, those marked whose rigid directions are not the same at another point."""
    if not any(wiring.rigid.names for wiring in evaluator.wirings):
        return evaluator.wirings
    base = np.array([value_now(evaluator.system, free) for free in evaluator.free])
    other = (base * (1 + _generic(len(base))[0][0]) + 1e-3).tolist()
    lifted = evaluator.lifted(np.array([other]))
    wirings = []
    for place, wiring in enumerate(evaluator.wirings):
        matrix = closed_loop(wiring, lifted)
        moves = bool(np.isfinite(matrix).all() and not are_rigid(wiring, matrix).all())
        if moves and not wiring.rigid.drifts:
            there = find_rigid_modes(evaluator.with_sites(evaluator.closed, other)[place], with_drifts=False)
            wirings.append(known_by_constants(wiring, there))
        else:
            wirings.append(wiring)
    return tuple(wirings)


def _generic(count: int) -> tuple[Floats, Floats]:
    """Return a point (1, count) and a direction that mean nothing, their ratios all different."""
    places = 1.0 + np.arange(count)
    return 0.5 + np.mod(GENERIC_POINT * places, 1.0)[None], 0.5 + np.mod(GENERIC_RATIO * places, 1.0)[None]


def _fixed(evaluator: BatchEvaluator) -> dict[tuple[int, int], Mapping[int, Matrices]]:
    """Return the exponentials of the groups whose A and B no free parameter moves, at a meaningless point."""
    if evaluator.timed:
        return {}
    result: dict[tuple[int, int], Mapping[int, Matrices]] = {}
    point, along = _generic(len(evaluator.free))
    for group in evaluator.groups:
        if site_key(group) in result:
            continue
        vectors = evaluator.vectors(group, point + (STEP * 1j) * along)
        site = site_of(group.jacobians, evaluator.rows(group.jacobians, vectors))
        if not (np.iscomplexobj(site.a) and (site.a.imag.any() or site.b.imag.any())):
            real = with_roundings(every_matrix(site, np.real))
            result[site_key(group)] = evaluator.steps(real, point, RADII)
    return result


def lifted_systems(systems: Sequence[Wired]) -> tuple[Wired, ...]:
    """Return systems whose sites are linearized and lifted at the parameters they have, each once."""
    known: dict[tuple[int, int], tuple[LinearSubsystem, FrameMap]] = {}

    def lifted(group: PeerClass) -> PeerClass:
        key, built = site_key(group), group.jacobians
        if key not in known:
            site = linearize(built, group.parameters)
            known[key] = site, lift(site, group.schedule, exact=group.exact)
        site, frame = known[key]
        return replace(group, site=site).with_lifted(frame)

    return tuple(replace(system, sites=tuple(map(lifted, system.sites))) for system in systems)


def is_beyond(a: Matrices, b: Matrices) -> NDArray[np.bool_]:
    """Say of each A and B whether they are too large, or not finite, for an exponential in floats."""
    size = np.abs(a).sum(axis=(1, 2)) + np.abs(b).sum(axis=(1, 2))
    beyond: NDArray[np.bool_] = ~(size < LARGEST)
    return beyond


def _lose(frame: FrameMap, lost: NDArray[np.bool_]) -> None:
    """Make NaN of the frames of sites that have no exponentials."""
    which = lost if len(lost) == len(frame.p) else slice(0, len(frame.p) if lost.any() else 0)
    frame.p[which] = frame.q[which] = np.nan


def _shared(a: Matrices, b: Matrices) -> tuple[Matrices, Matrices]:
    """Return A and B as one point's where they are the same at all, and real where they don't move."""
    if len(a) > 1 and (a == a[:1]).all() and (b == b[:1]).all():
        a, b = a[:1], b[:1]
    if np.iscomplexobj(a) and not (a.imag.any() or b.imag.any()):
        a, b = a.real.copy(), b.real.copy()
    return a, b


def _tangent(built: SubsystemJacobians) -> Any:
    """Return the coefficients and their derivative along a direction, as a function of (p, dp)."""
    arguments = built.function.sx_in()
    along = casadi.SX.sym("along", arguments[4].numel())
    zeros = [casadi.SX.zeros(argument.numel()) for argument in arguments]
    (flat,) = built.function.call([*zeros[:4], arguments[4], zeros[5]])
    slope = casadi.jtimes(flat, arguments[4], along)
    return casadi.Function("tangent", [arguments[4], along], [casadi.densify(flat), casadi.densify(slope)])
