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

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.closing import ClosedSystem, Feedback, close, feedback_of
from apc.eigen.dominant import misses_one
from apc.eigen.peer_group import PeerGroup
from apc.eigen.relative import Relative, relative_bounded
from apc.eigen.rigid import find_rigid_modes
from apc.frame.batch_lift import HOPELESS, PERTURBED_FRAMES, SAFE, lift_rows
from apc.frame.discretize import FEW_TOGETHER, UNIT, Step, exponential_rows, exponential_values
from apc.frame.lift import FrameMap, compose, roundings_of, with_roundings
from apc.frame.linearize import linearize_rows, sites_of_rows
from apc.frame.radius import FLOATS, RADII, Arithmetic, radius_of, value_of, with_radius
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
    exact = cache(lambda: family.exact_at(here.tolist()))  # asked for only where something may be rigid
    return [_moved(wiring, partial(_nth, exact, place), sites) for place, wiring in enumerate(family.wirings)]


def _nth(made: Callable[[], Sequence[ClosedSystem]], place: int) -> ClosedSystem:
    """Return one of what is made when it is asked for."""
    return made()[place]


def _moved(
    wiring: Wiring, exact: Callable[[], ClosedSystem], sites: Mapping[tuple[int, int], _Site]
) -> Moved:
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
    nothing = np.zeros((len(within), 0))
    if not (np.isfinite(within).all() and relative_at(wiring, matrix)[1].all()):
        return Moved(system.name, np.full_like(within, np.nan), off, (), nothing)
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
    missed = misses_one(within[None], off[None])[0]
    rigid = nothing if missed else _rigid_here(wiring, exact(), matrix, within)
    return Moved(system.name, within, off, tuple(through), rigid)


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
    value = linearize_rows(built, np.ascontiguousarray(vectors[:1].real))
    bounded = lift_rows(built, schedule, value).bounded
    site = sites_of_rows(built, value)
    if is_beyond(site.a, site.b).any():
        lost = bounded.mapped(lambda block: block * np.nan)
        return _Site(replace(bounded, p=lost.p, q=lost.q), ())
    places = np.flatnonzero(vectors.imag.any(axis=1))
    if not len(places):
        return _Site(bounded, ())
    rows = family.rows(built, vectors[places]).imag / STEP
    moving = (rows != 0).any(axis=1)  # NaN is
    places, rows = places[moving], rows[moving]
    some = max(1, AT_ONCE // bounded.p.shape[-1] ** 2)
    found = []
    for first in range(0, len(places), some):
        chosen = slice(first, first + some)
        stack = sites_of_rows(built, np.concatenate([value, rows[chosen]]))
        slopes, errors = _slopes(stack, schedule, family.durations)
        found.append(Slopes(places[chosen], _as_one(slopes), _as_one(errors)))
    return _Site(bounded, tuple(found))


def _as_one(frame: FrameMap) -> Matrices:
    """Return [P Q; S D]."""
    above, below = np.concatenate([frame.p, frame.q], axis=-1), np.concatenate([frame.s, frame.d], axis=-1)
    return np.concatenate([above, below], axis=-2)


def _slopes(
    site: LinearSite, schedule: Schedule, durations: Mapping[int, tuple[float, float]]
) -> tuple[FrameMap, FrameMap]:
    """Return the derivatives of a frame (k, …), and their errors.

    Where the bound on these says nothing, they are estimated as in `batch_lift`.

    Parameters
    ----------
    site
        The matrices of one point, and below them their derivatives by k parameters, (1 + k, …).
    schedule, durations
        What happens in a frame, and the seconds of its steps by quanta.
    """
    steps = {quanta: _step(site, seconds) for quanta, (seconds, _) in durations.items()}
    off = {
        quanta: with_radius(step.matrix, 2 * step.roundings * UNIT * step.size)
        for quanta, step in steps.items()
    }
    count = len(site.a) - 1
    bounds = compose(with_roundings(site), schedule, off, numbers=_with_slopes(RADII, count))
    slopes = bounds.mapped(lambda one: value_of(one)[1:])
    error = bounds.mapped(lambda one: radius_of(one)[1:])
    size = slopes.mapped(np.abs)
    if not (error.largest <= HOPELESS * size.largest).all():
        roundings = roundings_of(site, schedule, steps)
        random = np.random.default_rng(len(schedule.events))

        def moved(matrix: Floats) -> Floats:
            return np.asarray(matrix * (1 + roundings * UNIT * random.uniform(-1, 1, matrix.shape)))

        error = size.mapped(lambda one: roundings * UNIT * one)
        for _ in range(PERTURBED_FRAMES):
            # A step follows its site: what rounding makes of a stiff one is not what rounding it makes.
            off_a_little = every_matrix(site, moved)
            other = compose(
                off_a_little,
                schedule,
                {
                    quanta: moved(_followed(off_a_little, seconds))
                    for quanta, (seconds, _) in durations.items()
                },
                numbers=_with_slopes(FLOATS, count),
            )
            error = error.mapped(lambda e, a, b: np.maximum(e, SAFE * np.abs(a - b[1:])), slopes, other)
    return slopes, error


def _with_slopes(numbers: Arithmetic, count: int) -> Arithmetic:
    """Return the arithmetic of values, so many slopes below each (1 + count, …): (l r)′ = l r′ + l′ r."""

    def multiply(left: Matrices, right: Matrices) -> Matrices:
        found = numbers.multiply(left[:1], right)
        moved = 1 + np.flatnonzero(left[1:].any(axis=tuple(range(1, left.ndim))))
        if len(moved):
            found[moved] = numbers.add(found[moved], numbers.multiply(left[moved], right[:1]))
        return found

    def exact(value: Matrices) -> Matrices:
        one = numbers.exact(value)
        return np.concatenate([one[None], np.zeros((count, *one.shape))])

    return Arithmetic(multiply, numbers.add, numbers.subtract, exact)


def _differing(site: LinearSite) -> NDArray[np.intp]:
    """Return which derivatives of A and B there are, by their places below these."""
    return 1 + np.flatnonzero(site.a[1:].any(axis=(1, 2)) | site.b[1:].any(axis=(1, 2)))


def _followed(site: LinearSite, seconds: float) -> Floats:
    """Return a step (1 + k, n_x, n_x + n_u) with its derivatives below it."""
    (a, b), n_x, n_u = (site.a, site.b), *site.b.shape[-2:]
    found = np.zeros((len(a), n_x, n_x + n_u))
    found[:1] = exponential_values(a[:1], b[:1], seconds)
    moved = _differing(site)
    # Of a large site one by one, as its own products leave out the zeros.
    for some in np.split(moved, len(moved) if n_x > FEW_TOGETHER else 1) if len(moved) else ():
        near, pushed = (one[:1] + (STEP * 1j) * one[some] for one in (a, b))
        found[some] = exponential_values(near, pushed, seconds).imag / STEP
    return found


def _step(site: LinearSite, seconds: float) -> Step:
    """Return a step (1 + k, n_x, n_x + n_u), its derivatives below it, and the magnitudes of both.

    [F G]′ is the integral of F(T − s) [A′ B′] [F(s) G(s); 0 1] over s from 0 to T; what F reaches in between
    is taken from both ends and the middle.
    """
    (a, b), n_x, n_u = (site.a, site.b), *site.b.shape[-2:]
    step = exponential_rows(a[:1], b[:1], seconds)
    half = exponential_values(a[:1], b[:1], seconds / 2)
    found, size = _followed(site, seconds), np.zeros((len(a), n_x, n_x + n_u))
    found[:1], size[:1] = step.matrix, np.maximum(np.abs(step.matrix), step.size)
    moved = _differing(site)
    whole = np.maximum(np.maximum(step.size, np.abs(half)), np.eye(n_x, n_x + n_u))
    below = np.broadcast_to(np.eye(n_x + n_u)[n_x:], (1, n_u, n_x + n_u))
    slopes = np.abs(np.concatenate([a[moved], b[moved]], axis=-1))
    size[moved] = seconds * (whole[..., :n_x] @ slopes @ np.concatenate([whole, below], axis=-2))
    return Step(found, size, step.roundings)
