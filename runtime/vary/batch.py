"""The frame matrices of a system for many values of its parameters at once, with their derivatives.

Takes: groups of peers whose sites are affine, the exchange between them, and the parameters that vary.
Gives: `Evaluator`; `BatchEvaluator`, `batch_evaluator`, `matrix_errors`, `slope_errors`.
Guarantees: what is built once serves every value; rigid motions are taken out by their exact directions; a
derivative is exact to rounding. A point whose matrices are not finite, or that has other rigid motions than
its neighbours, comes out as NaN, never as a wrong number.
Does not: choose the groups (see `evaluator`), or compute eigenvalues.

Derivatives go by the complex step, M′ = Im M(p + i h p′)/h, which cancels nothing however small h (Squire and
Trapp, SIAM Review 40, 1998), through the composition of the frame; CasADi differentiates the coefficients.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.eigen.closing import ClosedSystem, close_loop
from apc.eigen.loop import Loop
from apc.eigen.modes import split
from apc.eigen.peer_group import PeerGroup
from apc.eigen.rigid import find_rigid_modes
from apc.frame.batch_lift import (
    HOPELESS,
    PERTURBED_FRAMES,
    SAFE,
    compose_rows,
    exponential_rows,
    lift_rows,
    roundings_of,
)
from apc.frame.discretize import UNIT
from apc.frame.exchange import Exchange
from apc.frame.jacobians import SiteJacobians
from apc.frame.lift import lift
from apc.frame.linearize import linearize_exact, linearize_rows, site_of_row, sites_of_rows
from apc.frame.names import Free, value_now
from apc.frame.parameters import free_rows
from apc.frame.schedule import Propagate, Schedule
from apc.frame.site import LinearSite, every_matrix
from apc.vary.wiring import (
    Lifted,
    Wiring,
    are_rigid,
    closed_loop,
    reduced,
    relative_weights,
    site_key,
    told_by_constants,
    wire,
)

Floats = NDArray[np.float64]
Matrices = NDArray[Any]  # float64 or complex128

# The complex step: its square vanishes beside 1, whatever the parameter's size.
STEP = 1e-60

# Where it is looked whether a free parameter moves an entry: at values of no meaning, each another, a
# derivative along as meaningless a direction that vanishes does so everywhere. (At one value for all, along a
# direction that moves all alike, a ratio such as k/m stays.)
GENERIC_POINT = 0.7390851332151607
GENERIC_RATIO = 0.6180339887498949

# An error from which nothing stands out; it is finite, so that 0 times it is 0.
NO_USE = 1e200

# A step shorter than this share of the delays it is the difference of is none.
VANISHING = 1e-14

# Rates beyond this, in 1/s or what stands for it, are not exponentiated: of a mass of 0, or next to it.
LARGEST = 1e15


class Evaluator(Protocol):
    """Frame matrices of closed systems over values of some parameters."""

    @property
    def free(self) -> tuple[Free, ...]:
        """The m parameters that vary, in the order of the columns of values."""

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return each system's reduced frame matrices (k, n, n) at values (k, m)."""

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return each system's matrices (k, n, n) and their derivatives along directions (k, m)."""

    def closed_at(self, value: Sequence[float]) -> tuple[ClosedSystem, ...]:
        """Return the closed systems at one point (m,), as an analysis has them: with error bounds."""


@dataclass(frozen=True, slots=True, eq=False)
class BatchEvaluator:
    """An `Evaluator` of a scene whose matrices follow from its parameters in closed form.

    `durations` are the seconds of each step by its quanta, as (constant, slope), the slope over the only free
    value where that is a time. `tangents` are the coefficients of each kind with their derivatives, none
    where a time varies that stands in no coefficient; `fixed` the exponentials of the groups where nothing
    free reaches them.
    """

    system: CompiledSystem
    free: tuple[Free, ...]
    exchange: Exchange
    groups: tuple[PeerGroup, ...]
    wirings: tuple[Wiring, ...]
    durations: Mapping[int, tuple[float, float]]
    tangents: Mapping[str, Any]  # casadi.Function by the kind's name
    fixed: Mapping[tuple[int, int], Mapping[int, Matrices]]  # exponentials that nothing free reaches

    @property
    def closed(self) -> tuple[ClosedSystem, ...]:
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

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return each system's matrices (k, n, n) and their derivatives along directions (k, m)."""
        lifted = self.lifted(values + (STEP * 1j) * along)
        found = (reduced(wiring, closed_loop(wiring, lifted), len(values)) for wiring in self.wirings)
        return tuple((one.real.copy(), one.imag / STEP) for one in found)

    def vectors(self, group: PeerGroup, values: Matrices) -> Matrices:
        """Return the parameter vectors (k, n_p) of a group, or (1, n_p) when no value reaches it."""
        if not self.tangents:
            return group.parameters[None]
        place, peer = self.first_peer(group)
        listed = {free: values[:, column] for column, free in enumerate(self.free)}
        return free_rows(self.system, self.system.groups[place], peer, listed)

    def first_peer(self, group: PeerGroup) -> tuple[int, int]:
        """Return which group of the scene the first of a group of like peers is of, and its number there."""
        first = int(group.peers[0])
        place = int(np.searchsorted(self.exchange.starts, first, side="right")) - 1
        return place, first - int(self.exchange.starts[place])

    def closed_at(self, value: Sequence[float]) -> tuple[ClosedSystem, ...]:
        """Return the closed systems at one point (m,), as an analysis has them: with error bounds."""
        return tuple(self.system_at(value, place) for place in range(len(self.wirings)))

    def system_at(self, value: Sequence[float], place: int) -> ClosedSystem:
        """Return one closed system at one point (m,), as an analysis has it: with error bounds."""
        assert not self.timed, "another time is another schedule"
        system = self.wirings[place].system
        used = {site_key(group) for group in system.sites}
        moved = {
            site_key(group): _moved(group, vector)
            for group, vector in self._points(value)
            if site_key(group) in used
        }
        sites = [
            replace(one, parameters=new.parameters, site=new.site, exact=new.exact, lifted=new.lifted)
            for one in system.sites
            if (new := moved[site_key(one)])
        ]
        return close_loop(
            Loop(
                system.name,
                system.multiplicity,
                tuple(sites),
                system.coupling,
                system.doubts,
                system.surds,
            )
        )

    def exact_at(self, value: Sequence[float]) -> tuple[ClosedSystem, ...]:
        """Return the closed systems with the sites of one point (m,), for exact arithmetic.

        Their matrices in floats are still those of the point that stands for all.
        """
        assert not self.timed, "another time is another schedule"
        return self.sites_at(value)

    def sites_at(self, value: Sequence[float]) -> tuple[ClosedSystem, ...]:
        """Return the same, whatever varies; of a time, all but the steps is of that point."""
        moved = {
            site_key(group): (vector, linearize_exact(group.jacobians, vector))
            for group, vector in self._points(value)
        }

        def at_point(group: PeerGroup) -> PeerGroup:
            vector, exact = moved[site_key(group)]
            return replace(group, parameters=vector, exact=exact)

        return tuple(replace(system, sites=tuple(map(at_point, system.sites))) for system in self.closed)

    def _points(self, value: Sequence[float]) -> list[tuple[PeerGroup, Floats]]:
        point = np.array([value], dtype=np.float64)
        return [(group, self.vectors(group, point)[0]) for group in self.groups]

    def lifted(self, values: Matrices) -> dict[tuple[int, int], Lifted]:
        """Return the maps of all groups, each once, by the identity of site and schedule."""
        found: dict[tuple[int, int], Lifted] = {}
        for group in self.groups:
            if site_key(group) not in found:
                found[site_key(group)] = self._lift(group, values)
        return found

    def _lift(self, group: PeerGroup, values: Matrices) -> Lifted:
        built, schedule = group.jacobians, group.schedule
        rows = self.rows(built, self.vectors(group, values))
        site = sites_of_rows(built, rows)
        beyond = _beyond(site.a, site.b)
        steps = self.fixed.get(site_key(group))
        if steps is None:
            site.a[beyond], site.b[beyond] = 0.0, 0.0  # they would spoil the others' exponentials
            steps = self.steps(site, values)
        count = max(len(rows), *(len(step) for step in steps.values()), 1)
        kind_of_number = np.result_type(rows, *steps.values())
        if count > len(rows) or kind_of_number != rows.dtype:
            rows = np.broadcast_to(rows, (count, rows.shape[1])).astype(kind_of_number)
            site = sites_of_rows(built, rows)
        with np.errstate(all="ignore"):
            z, s = compose_rows(site, schedule, steps)
        z[beyond if len(beyond) == len(z) else slice(0, len(z) if beyond.any() else 0)] = np.nan
        n_z = z.shape[1]
        return Lifted(z[..., :n_z], z[..., n_z:], s[..., :n_z], s[..., n_z:])

    def steps(self, site: LinearSite, values: Matrices) -> dict[int, Matrices]:
        """Return the exponentials of every step, one for all points where A, B and the time stay."""
        a, b = _shared(site.a, site.b)
        steps = {}
        for quanta, (constant, slope) in self.durations.items():
            seconds = np.full((1, 1, 1), constant)
            if slope:
                seconds = constant + slope * values[:, 0, None, None]
                # What is left of a step that vanishes is rounding, which would upset the eigenvectors.
                gone = np.abs(seconds) < VANISHING * abs(constant)
                seconds = np.where(gone, seconds - seconds.real, seconds)
            with np.errstate(all="ignore"):
                steps[quanta] = exponential_rows(a * seconds, b * seconds, 1.0)[0]
        return steps

    def rows(self, built: SiteJacobians, vectors: Matrices) -> Matrices:
        """Return the coefficients (k, …) of many sites; those of a complex step with their derivative."""
        if not np.iscomplexobj(vectors):
            return linearize_rows(built, vectors)
        both = self.tangents[built.kind.name](vectors.real.T, vectors.imag.T / STEP)
        value, slope = (np.asarray(one, dtype=np.float64).reshape(-1, len(vectors)).T for one in both)
        return value + (STEP * 1j) * slope


def batch_evaluator(
    system: CompiledSystem,
    free: Sequence[Free],
    groups: Sequence[PeerGroup],
    exchange: Exchange,
    *,
    durations: Mapping[int, tuple[float, float]] | None = None,
    follows: bool = True,
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
    """
    systems = split(groups, exchange).systems
    if durations is None:
        durations = {
            event.duration: (float(event.duration * group.schedule.quantum), 0.0)
            for group in groups
            for event in group.schedule.events
            if isinstance(event, Propagate)
        }
    tangents = {one.jacobians.kind.name: _tangent(one.jacobians) for one in groups} if follows else {}
    found = BatchEvaluator(
        system=system,
        free=tuple(free),
        exchange=exchange,
        groups=tuple(groups),
        wirings=tuple(wire(one) for one in systems),
        durations=durations,
        tangents=tangents,
        fixed={},
    )
    found = replace(found, fixed=_fixed(found))
    return replace(found, wirings=_told_apart(found)) if follows else found


def _told_apart(evaluator: BatchEvaluator) -> tuple[Wiring, ...]:
    """Return the wirings, those marked whose rigid directions are not the same at another point."""
    if not any(wiring.rigid.names for wiring in evaluator.wirings):
        return evaluator.wirings
    base = np.array([value_now(evaluator.system, one) for one in evaluator.free])
    other = (base * (1 + _generic(len(base))[0][0]) + 1e-3).tolist()
    lifted = evaluator.lifted(np.array([other]))
    found = []
    for place, wiring in enumerate(evaluator.wirings):
        matrix = closed_loop(wiring, lifted)
        moves = bool(np.isfinite(matrix).all() and not are_rigid(wiring, matrix).all())
        if moves and not wiring.rigid.drifts:
            there = find_rigid_modes(evaluator.sites_at(other)[place], with_drifts=False)
            found.append(told_by_constants(wiring, there))
        else:
            found.append(wiring)
    return tuple(found)


def _generic(count: int) -> tuple[Floats, Floats]:
    """Return a point (1, count) and a direction that mean nothing, their ratios all different."""
    places = 1.0 + np.arange(count)
    return 0.5 + np.mod(GENERIC_POINT * places, 1.0)[None], 0.5 + np.mod(GENERIC_RATIO * places, 1.0)[None]


def _fixed(evaluator: BatchEvaluator) -> dict[tuple[int, int], Mapping[int, Matrices]]:
    """Return the exponentials of the groups whose A and B no free parameter moves, at a meaningless point."""
    if evaluator.timed:
        return {}
    found: dict[tuple[int, int], Mapping[int, Matrices]] = {}
    point, along = _generic(len(evaluator.free))
    for group in evaluator.groups:
        if site_key(group) in found:
            continue
        vectors = evaluator.vectors(group, point + (STEP * 1j) * along)
        site = sites_of_rows(group.jacobians, evaluator.rows(group.jacobians, vectors))
        if not (np.iscomplexobj(site.a) and (site.a.imag.any() or site.b.imag.any())):
            found[site_key(group)] = evaluator.steps(site, point)
    return found


def matrix_errors(evaluator: BatchEvaluator, values: Floats) -> tuple[Floats, ...]:
    """Return bounds (k, n, n) on the rounding errors of each system's reduced matrices, entry by entry.

    Parameters
    ----------
    evaluator
        The evaluator; no time varies in it.
    values
        The points (k, m).

    Notes
    -----
    The composition of magnitudes and that of magnitudes with their errors differ by a bound on the error to
    all orders, as in `modes.close_loop`; the roundings of closing are added to it.
    """
    assert not evaluator.timed, "the errors of a step belong to its time"
    plain = evaluator.lifted(values)
    large: dict[tuple[int, int], Lifted] = {}
    wide: dict[tuple[int, int], Lifted] = {}
    for group in evaluator.groups:
        rows = linearize_rows(group.jacobians, evaluator.vectors(group, values))
        one = lift_rows(group.jacobians, group.schedule, rows)
        sizes = [np.abs(block) for block in (one.p, one.q, one.s, one.d)]
        errors = (one.p_error, one.q_error, one.s_error, one.d_error)
        large[site_key(group)] = Lifted(*sizes)
        wide[site_key(group)] = Lifted(*(a + b for a, b in zip(sizes, errors, strict=True)))
    found = []
    for wiring in evaluator.wirings:
        positive = replace(
            wiring,
            now=tuple(map(np.abs, wiring.now)),
            before=tuple(map(np.abs, wiring.before)),
        )
        bound, upper = closed_loop(positive, large), closed_loop(positive, wide)
        terms = max(len(group.lifted.z_names) for group in wiring.system.sites)
        terms += sum(now.shape[0] + now.shape[1] for now in wiring.now)
        error = (upper - bound) + 4 * (terms + 2) * (1 + len(wiring.now[0])) * UNIT * upper
        rest, held = wiring.rest, wiring.held
        own = error[:, rest[:, None], rest]
        if len(held):
            weights, off = _relative_errors(wiring, closed_loop(wiring, plain), error)
            below, wide_below = error[:, held[:, None], rest], upper[:, held[:, None], rest]
            own = own + np.abs(weights) @ (below + 8 * (len(held) + 2) * UNIT * wide_below) + off @ wide_below
        found.append(np.broadcast_to(own, (len(values), *own.shape[1:])))
    return tuple(found)


def slope_errors(evaluator: BatchEvaluator, values: Floats, along: Floats) -> tuple[Floats, ...]:
    """Return bounds (k, n, n), to first order, on the rounding errors of each system's reduced slopes.

    Parameters
    ----------
    evaluator
        The evaluator; no time varies in it.
    values, along
        The points and directions (k, m), as for `BatchEvaluator.slopes`.

    Notes
    -----
    A complex step whose every number is replaced by its magnitudes, of value and of slope, comes out as the
    magnitudes of all that was added up on either way: both are off by the roundings of a frame times that.
    Where that says nothing, it is estimated as in `batch_lift`.
    """
    assert not evaluator.timed, "the errors of a step belong to its time"
    complex_values = values + (STEP * 1j) * along
    large: dict[tuple[int, int], Lifted] = {}
    wide: dict[tuple[int, int], Lifted] = {}
    for group in evaluator.groups:
        built, schedule = group.jacobians, group.schedule
        rows = evaluator.rows(built, evaluator.vectors(group, complex_values))
        here = lift_rows(built, schedule, rows.real[:1])
        value_errors = (here.p_error, here.q_error, here.s_error, here.d_error)
        size, off = _moved_blocks(sites_of_rows(built, rows), schedule, evaluator.durations)
        large[site_key(group)] = Lifted(*size)
        wide[site_key(group)] = Lifted(
            *(a + b + (STEP * 1j) * c for a, b, c in zip(size, value_errors, off, strict=True))
        )
    found = []
    errors, plain = matrix_errors(evaluator, values), evaluator.lifted(complex_values)
    for wiring, error in zip(evaluator.wirings, errors, strict=True):
        whole = replace(wiring, now=tuple(map(np.abs, wiring.now)), before=tuple(map(np.abs, wiring.before)))
        terms = max(len(group.lifted.z_names) for group in wiring.system.sites)
        terms += sum(now.shape[0] + now.shape[1] for now in wiring.now)
        bound, upper = (closed_loop(whole, one).imag / STEP for one in (large, wide))
        off = (upper - bound) + 8 * (terms + 2) * (1 + len(wiring.now[0])) * UNIT * upper
        rest, held = wiring.rest, wiring.held
        own = off[:, rest[:, None], rest]
        if len(held):
            matrix = closed_loop(wiring, plain)
            weights, _ = relative_weights(wiring, matrix)
            moved, turned = np.abs(matrix.imag / STEP), np.abs(weights.imag / STEP)
            below = off[:, held[:, None], rest] + 8 * (len(held) + 2) * UNIT * moved[:, held[:, None], rest]
            own = own + np.abs(weights.real) @ below
            if wiring.moving:
                inverse = _inverse_size(np.eye(len(rest)) - matrix.real[:, rest[:, None], rest])
                heavy = np.abs(weights.real)
                late = off[:, rest[:, None], held] + off[:, rest[:, None], rest] @ heavy + error @ turned
                late = late + 8 * (len(rest) + 2) * UNIT * (turned + moved[:, rest[:, None], rest] @ heavy)
                own = own + (inverse @ late) @ np.abs(matrix.real[:, held[:, None], rest])
        found.append(np.broadcast_to(own, (len(values), *own.shape[1:])))
    return tuple(found)


def _moved_blocks(
    site: LinearSite, schedule: Schedule, durations: Mapping[int, tuple[float, float]]
) -> tuple[tuple[Matrices, ...], tuple[Floats, ...]]:
    """Return the sizes of P, Q, S and D, of their slopes as a complex step, and the errors of the slopes."""
    plain, steps, charges = {}, {}, {}
    for quanta, (seconds, _) in durations.items():
        plain[quanta] = exponential_rows(site.a * seconds, site.b * seconds, 1.0)[0]
        steps[quanta], charges[quanta] = _large_step(site, seconds)
    roundings = roundings_of(site, schedule, charges)
    frame = compose_rows(site, schedule, plain)
    bounds = compose_rows(every_matrix(site, _sized), schedule, steps)
    errors = [(2 * roundings * UNIT / STEP) * one.imag for one in bounds]
    slopes = [np.abs(one.imag) / STEP for one in frame]
    if not all(
        e.max(initial=0.0) <= HOPELESS * s.max(initial=0.0) for e, s in zip(errors, slopes, strict=True)
    ):
        random = np.random.default_rng(len(schedule.events))

        def moved(matrix: Matrices) -> Matrices:
            by = roundings * UNIT * random.uniform(-1, 1, (2, *matrix.shape))
            return np.asarray(matrix.real * (1 + by[0]) + 1j * (matrix.imag * (1 + by[1])))

        errors = [roundings * UNIT * slope for slope in slopes]
        for _ in range(PERTURBED_FRAMES):
            other = compose_rows(
                every_matrix(site, moved), schedule, {quanta: moved(step) for quanta, step in plain.items()}
            )
            apart = (SAFE * np.abs(one.imag - two.imag) / STEP for one, two in zip(frame, other, strict=True))
            errors = [np.maximum(one, two) for one, two in zip(errors, apart, strict=True)]
    n_z = frame[0].shape[1]
    cut = [(block, columns) for block in (0, 1) for columns in (slice(None, n_z), slice(n_z, None))]
    return (
        tuple(_sized(frame[block])[..., columns] for block, columns in cut),
        tuple(errors[block][..., columns] for block, columns in cut),
    )


def _sized(matrix: Matrices) -> Matrices:
    """Return the magnitudes of values and slopes as numbers with a complex step."""
    return np.asarray(np.abs(matrix.real) + 1j * np.abs(matrix.imag))


def _large_step(site: LinearSite, seconds: float) -> tuple[Matrices, float]:
    """Return the magnitudes of a step and of its slope, and its roundings.

    [F G]′ is the integral of F(T − s) [A′ B′] [F(s) G(s); 0 1] over s from 0 to T; what F reaches in between
    is taken from both ends and the middle.
    """
    a, b = np.abs(site.a.imag), np.abs(site.b.imag)
    step, size, charge = exponential_rows(site.a.real, site.b.real, seconds)
    half, _, _ = exponential_rows(site.a.real, site.b.real, seconds / 2)
    n_x, n_u = b.shape[-2:]
    whole = np.maximum(np.maximum(size, np.abs(half)), np.eye(n_x, n_x + n_u))
    below = np.broadcast_to(np.eye(n_x + n_u)[n_x:], (*whole.shape[:-2], n_u, n_x + n_u))
    slope = whole[..., :n_x] @ np.concatenate([a, b], axis=-1) @ np.concatenate([whole, below], axis=-2)
    return np.maximum(np.abs(step), size) + 1j * seconds * slope, charge


def _inverse_size(matrices: Floats) -> Floats:
    """Return |M⁻¹| of matrices (k, n, n); `NO_USE` where one has none, as more is free at these values."""
    try:
        return np.asarray(np.abs(np.linalg.inv(matrices)))
    except np.linalg.LinAlgError:
        return np.full(matrices.shape, NO_USE)


def _relative_errors(wiring: Wiring, matrix: Floats, error: Floats) -> tuple[Floats, Floats]:
    """Return W at each point and a bound on its error, to first order where the directions follow.

    (1 − M_rr) W = M_rp: W is off by (1 − M_rr)⁻¹ times what the errors of M leave, and the solution's own.
    """
    weights, _ = relative_weights(wiring, matrix)
    if not wiring.moving:
        return weights, 8 * (len(wiring.held) + 2) * UNIT * np.abs(weights)[None]
    rest, held = wiring.rest, wiring.held
    system = np.eye(len(rest)) - matrix[:, rest[:, None], rest]
    size = _inverse_size(system)
    left = error[:, rest[:, None], held] + error[:, rest[:, None], rest] @ np.abs(weights)
    left = left + 8 * (len(rest) + 2) * UNIT * (np.abs(system) @ np.abs(weights))
    return weights, size @ left


def _moved(group: PeerGroup, vector: Floats) -> PeerGroup:
    """Return the group with other parameters, linearized and lifted anew."""
    built = group.jacobians
    site = site_of_row(built, linearize_rows(built, vector[None])[0])
    exact = linearize_exact(built, vector)
    lifted = lift(site, group.schedule, exact=exact)
    return replace(group, parameters=vector, site=site, exact=exact, lifted=lifted)


def _beyond(a: Matrices, b: Matrices) -> NDArray[np.bool_]:
    """Say of each A and B whether they are too large, or not finite, for an exponential in floats."""
    size = np.abs(a).sum(axis=(1, 2)) + np.abs(b).sum(axis=(1, 2))
    beyond: NDArray[np.bool_] = ~(size < LARGEST)
    return beyond


def _shared(a: Matrices, b: Matrices) -> tuple[Matrices, Matrices]:
    """Return A and B as one point's where they are the same at all, and real where they don't move."""
    if len(a) > 1 and (a == a[:1]).all() and (b == b[:1]).all():
        a, b = a[:1], b[:1]
    if np.iscomplexobj(a) and not (a.imag.any() or b.imag.any()):
        a, b = a.real.copy(), b.real.copy()
    return a, b


def _tangent(built: SiteJacobians) -> Any:
    """Return the coefficients and their derivative along a direction, as a function of (p, dp)."""
    arguments = built.function.sx_in()
    along = casadi.SX.sym("along", arguments[4].numel())
    zeros = [casadi.SX.zeros(one.numel()) for one in arguments]
    (flat,) = built.function.call([*zeros[:4], arguments[4], zeros[5]])
    slope = casadi.jtimes(flat, arguments[4], along)
    return casadi.Function("tangent", [arguments[4], along], [casadi.densify(flat), casadi.densify(slope)])
