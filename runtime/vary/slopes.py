"""The derivatives of frame matrices by every parameter, kept as those of the sites the parameters stand in.

Takes: a `BatchEvaluator` and a point.
Gives: `Moved`, `Through`; `moved_systems`.
Guarantees: all of it comes with bounds on its rounding errors, to first order; a derivative that can't be had
is NaN.
Does not: build the derivative of a whole matrix; know about eigenvalues.

A parameter moves the map [z⁺; s] = F [z; r] of the sites it stands in, F = [P Q; S D], and nothing else: with
y = B x what a site's z and r are of the state, and A what is made of its z⁺ and s,   dM = Σ A dF B   over the
sites. A product of dM and a vector is a few products of one site.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.closing import ClosedSystem, Feedback, close, feedback_of
from apc.eigen.peer_group import PeerGroup
from apc.eigen.relative import Relative, relative_bounded
from apc.eigen.rigid import find_rigid_modes
from apc.frame.batch_lift import HOPELESS, PERTURBED_FRAMES, SAFE, lift_rows
from apc.frame.discretize import UNIT, Step, exponential_rows
from apc.frame.lift import FrameMap, compose, roundings_of, with_roundings
from apc.frame.linearize import sites_of_rows
from apc.frame.radius import RADII, radius_of, value_of, with_radius
from apc.frame.schedule import Schedule
from apc.frame.site import LinearSite, every_matrix
from apc.vary.batch import STEP, BatchEvaluator, inverse_size, is_beyond, relative_here
from apc.vary.wiring import NEAR_ONE, Wiring, relative_at, site_key

Floats = NDArray[np.float64]
Matrices = NDArray[Any]  # float64 or complex128

# Entries of matrices that are differentiated at once: some hundred megabytes with all that is made of them.
AT_ONCE = 500_000


@dataclass(frozen=True, slots=True, eq=False)
class Slopes:
    """How a map F (a, b) follows k parameters, `places` among all: dF (k, a, b), and what that is off by."""

    places: NDArray[np.intp]
    matrices: Floats
    errors: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Through:
    """What a matrix (n, n) owes to the derivative of one map: A dF B, each with its error.

    `outward` is A (n, a), `inward` B (b, n).
    """

    slopes: Slopes
    outward: Floats
    outward_error: Floats
    inward: Floats
    inward_error: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """A closed system's matrix M (n, n) with its error, and through what it follows the parameters.

    `rigid` (n, k) are motions that nothing holds back at these values, though something might at others:
    M V spans what V does. All other eigenvalues are those to differentiate.
    """

    name: str
    matrix: Floats
    error: Floats
    through: tuple[Through, ...]
    rigid: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Site:
    """The map of a site at the point with its radii, (1, 2, …), and how it follows the parameters."""

    bounded: FrameMap
    slopes: tuple[Slopes, ...]


def moved_systems(family: BatchEvaluator, here: Floats) -> list[Moved]:
    """Return every closed system at a point (m,), and through what its matrix follows the parameters."""
    sites: dict[tuple[int, int], _Site] = {}
    for group in family.groups:
        if site_key(group) not in sites:
            sites[site_key(group)] = _site(family, group, here)
    exact = family.exact_at(here.tolist())
    return [_moved(*pair, sites) for pair in zip(family.wirings, exact, strict=True)]


def _moved(wiring: Wiring, exact: ClosedSystem, sites: Mapping[tuple[int, int], _Site]) -> Moved:
    """Return one closed system with what it follows, in relative coordinates; NaN where these are not."""
    system, layout = wiring.system, wiring.system.layout
    own = [sites[site_key(group)] for group in system.sites]
    n = len(layout.names)
    feedback = feedback_of(system, layout)
    counts = [one.bounded.s.shape[-2] for one in own]
    starts = np.cumsum([0, *counts])
    closed = close(
        [_added_to(one.bounded) for one in own],
        [
            _added_by(one, start, count, starts[-1])
            for one, start, count in zip(feedback, starts, counts, strict=False)
        ],
        layout,
        numbers=RADII,
    )
    matrix, error = value_of(closed.matrix), radius_of(closed.matrix)
    upon, upon_error = matrix[0, :, n:], error[0, :, n:]  # what a packet that is sent more makes of the state
    matrix, error = matrix[..., :n], error[..., :n]
    at = relative_here(wiring, matrix, error)
    within, off = (one[0] for one in relative_bounded(matrix, error, at))
    if not (np.isfinite(within).all() and relative_at(wiring, matrix)[1].all()):
        return Moved(system.name, np.full_like(within, np.nan), off, (), np.zeros((len(within), 0)))
    through: list[Through] = []
    for one, start, count, offset, r in zip(own, starts, counts, layout.offsets, closed.heard, strict=False):
        z = np.eye(n)[offset : offset + one.bounded.p.shape[-1]]
        hears = one.bounded.q.shape[-1]
        columns = slice(start, start + count)
        for slopes in one.slopes:
            whole = Through(
                slopes,
                np.hstack([z.T, upon[:, columns]]),
                np.hstack([0 * z.T, upon_error[:, columns]]),
                np.vstack([z, value_of(r)[..., :hears, :n].reshape(hears, n)]),
                np.vstack([0 * z, radius_of(r)[..., :hears, :n].reshape(hears, n)]),
            )
            through += _relative(whole, at, matrix[0], error[0], moving=wiring.moving)
    return Moved(system.name, within, off, tuple(through), _rigid_here(wiring, exact, matrix, within))


def _added_to(one: FrameMap) -> FrameMap:
    """Return a site's map with an input more for each packet it sends, which is added to it."""
    nothing = np.zeros((*one.q.shape[:-1], one.s.shape[-2]))
    unit = RADII.exact(np.eye(one.s.shape[-2]))
    unit = np.broadcast_to(unit, (*one.d.shape[:-2], *unit.shape[-2:]))
    return replace(one, q=np.concatenate([one.q, nothing], axis=-1), d=np.concatenate([one.d, unit], axis=-1))


def _added_by(one: Feedback, start: int, count: int, sent: int) -> Feedback:
    """Return what a site hears and, below, what is added to its packets, which comes from outside."""
    _, hears, n = one.before.shape
    now, before = np.zeros((2, hears + count, sent)), np.zeros((2, hears + count, n + sent))
    now[:, :hears], before[:, :hears, :n] = one.now, one.before
    before[0, hears:, n + start : n + start + count] = np.eye(count)
    return Feedback(now, before)


def _relative(
    whole: Through, at: Relative, matrix: Floats, error: Floats, *, moving: bool
) -> Iterator[Through]:
    """Yield through what the map of relative coordinates, M_rr − W M_pr, owes to the derivative of a map.

    Where W follows the parameters, (1 − M_rr) W = M_rp, it changes by (1 − M_rr)⁻¹ (dM V)_r, V = [W; 1].
    """
    held, rest = at.held, at.rest
    weights, doubt = (one[0] if one.ndim == 3 else one for one in (at.weights, at.doubt))
    heavy = np.abs(weights)
    out, out_error = whole.outward, whole.outward_error
    charge = 2 * (len(held) + 2) * UNIT
    yield Through(
        whole.slopes,
        out[rest] - weights @ out[held],
        out_error[rest]
        + heavy @ (out_error[held] + charge * np.abs(out[held]))
        + doubt @ np.abs(out[held])
        + UNIT * np.abs(out[rest]),
        whole.inward[:, rest],
        whole.inward_error[:, rest],
    )
    if not moving:
        return
    inward, off = whole.inward, whole.inward_error
    charge = 8 * (len(rest) + 2) * UNIT
    system = np.eye(len(rest)) - matrix[np.ix_(rest, rest)]
    size = inverse_size(system[None])[0]
    turned = np.asarray(np.linalg.solve(system, out[rest]), np.float64)
    left = out_error[rest] + (error[np.ix_(rest, rest)] + charge * np.abs(system)) @ np.abs(turned)
    along = inward[:, rest] @ weights + inward[:, held]
    along_size = np.abs(inward[:, rest]) @ heavy + np.abs(inward[:, held])
    along_off = off[:, rest] @ heavy + off[:, held] + np.abs(inward[:, rest]) @ doubt + charge * along_size
    pushes, pushes_off = matrix[np.ix_(held, rest)], error[np.ix_(held, rest)]
    yield Through(
        whole.slopes,
        -turned,
        size @ left,
        along @ pushes,
        along_off @ np.abs(pushes) + np.abs(along) @ (pushes_off + charge * np.abs(pushes)),
    )


def _rigid_here(wiring: Wiring, system: ClosedSystem, matrix: Floats, within: Floats) -> Floats:
    """Return what is rigid at these values beyond what is so at all, in relative coordinates (n, k).

    `system` has the exact sites of these values, `matrix` (1, n, n) is its own, `within` the relative one.
    """
    free = find_rigid_modes(system, with_drifts=False)
    at_one = int(np.sum(np.abs(np.linalg.eigvals(within) - 1) < NEAR_ONE))
    if at_one > free.directions.shape[1] - wiring.rigid.directions.shape[1]:
        free = find_rigid_modes(system)
    more = free.basis.shape[1] - len(wiring.relative.held)
    if more <= 0:
        return np.zeros((len(within), 0))
    at, _ = relative_at(wiring, matrix)
    weights = at.weights if at.weights.ndim == 2 else at.weights[0]
    relative = free.basis[at.rest] - weights @ free.basis[at.held]
    return np.linalg.svd(relative, full_matrices=False)[0][:, :more]


def _site(family: BatchEvaluator, group: PeerGroup, here: Floats) -> _Site:
    """Return the map of a group at a point (m,), and how it follows those parameters that reach it."""
    built, schedule = group.jacobians, group.schedule
    along = np.eye(len(here)) if len(here) else np.zeros((1, 0))
    vectors = family.vectors(group, here + (STEP * 1j) * along)
    places = np.flatnonzero(vectors.imag.any(axis=1))
    rows = family.rows(built, vectors[places] if len(places) else vectors[:1].real)
    bounded = lift_rows(built, schedule, np.ascontiguousarray(rows.real[:1])).bounded
    if not len(places):
        return _Site(bounded, ())
    moving = rows.imag != 0  # NaN is
    places, rows = places[moving.any(axis=1)], rows[moving.any(axis=1)]
    site = sites_of_rows(built, rows)
    if is_beyond(site.a[:1].real, site.b[:1].real).any():
        lost = bounded.mapped(lambda block: block * np.nan)
        return _Site(replace(bounded, p=lost.p, q=lost.q), ())
    inside = site.a.imag.any(axis=(1, 2)) | site.b.imag.any(axis=(1, 2))
    some = max(1, AT_ONCE // bounded.p.shape[-1] ** 2)
    found = []
    for ones in (np.flatnonzero(inside), np.flatnonzero(~inside)):
        for first in range(0, len(ones), some):
            chosen = ones[first : first + some]
            frame, error = _moved_blocks(sites_of_rows(built, rows[chosen]), schedule, family.durations)
            found.append(Slopes(places[chosen], _as_one(frame).imag / STEP, _as_one(error)))
    return _Site(bounded, tuple(found))


def _as_one(frame: FrameMap) -> Matrices:
    """Return [P Q; S D]."""
    above, below = np.concatenate([frame.p, frame.q], axis=-1), np.concatenate([frame.s, frame.d], axis=-1)
    return np.concatenate([above, below], axis=-2)


def _moved_blocks(
    site: LinearSite, schedule: Schedule, durations: Mapping[int, tuple[float, float]]
) -> tuple[FrameMap, FrameMap]:
    """Return a frame with its slopes as a complex step, and the errors of the slopes.

    A number with a complex step has a radius with one: what its value and what its slope is off by. Where the
    slope's says nothing, it is estimated as in `batch_lift`.
    """
    plain, steps = {}, {}
    a, b = site.a, site.b
    if not (a.imag.any() or b.imag.any()):
        a, b = np.ascontiguousarray(a.real[:1]), np.ascontiguousarray(b.real[:1])
    for quanta, (seconds, _) in durations.items():
        plain[quanta] = exponential_rows(a * seconds, b * seconds, 1.0).matrix
        steps[quanta] = _large_step(a, b, seconds)
    off = {
        quanta: with_radius(plain[quanta].astype(np.complex128), 2 * step.roundings * UNIT * step.matrix)
        for quanta, step in steps.items()
    }
    bounds = compose(with_roundings(site), schedule, off, numbers=RADII)
    frame = bounds.mapped(value_of)
    error = bounds.mapped(lambda one: radius_of(one).imag / STEP)
    slope = frame.mapped(lambda one: np.abs(one.imag) / STEP)
    roundings = roundings_of(site, schedule, steps)
    if not (error.largest <= HOPELESS * slope.largest).all():
        random = np.random.default_rng(len(schedule.events))

        def moved(matrix: Matrices) -> Matrices:
            by = roundings * UNIT * random.uniform(-1, 1, (2, *matrix.shape))
            return np.asarray(matrix.real * (1 + by[0]) + 1j * (matrix.imag * (1 + by[1])))

        error = slope.mapped(lambda one: roundings * UNIT * one)
        for _ in range(PERTURBED_FRAMES):
            other = compose(
                every_matrix(site, moved), schedule, {quanta: moved(step) for quanta, step in plain.items()}
            )
            error = error.mapped(
                lambda e, a, b: np.maximum(e, SAFE * np.abs(a.imag - b.imag) / STEP), frame, other
            )
    return frame, error


def _large_step(a: Matrices, b: Matrices, seconds: float) -> Step:
    """Return the magnitudes of a step and of its slope, with its roundings.

    [F G]′ is the integral of F(T − s) [A′ B′] [F(s) G(s); 0 1] over s from 0 to T; what F reaches in between
    is taken from both ends and the middle.
    """
    step = exponential_rows(a[:1].real, b[:1].real, seconds)  # it is one point's
    half = exponential_rows(a[:1].real, b[:1].real, seconds / 2).matrix
    n_x, n_u = b.shape[-2:]
    whole = np.maximum(np.maximum(step.size, np.abs(half)), np.eye(n_x, n_x + n_u))
    below = np.broadcast_to(np.eye(n_x + n_u)[n_x:], (*whole.shape[:-2], n_u, n_x + n_u))
    moved = np.concatenate([np.abs(a.imag), np.abs(b.imag)], axis=-1)
    slope = whole[..., :n_x] @ moved @ np.concatenate([whole, below], axis=-2)
    large = np.maximum(np.abs(step.matrix), step.size)
    return Step(large + 1j * seconds * slope, large, step.roundings)
