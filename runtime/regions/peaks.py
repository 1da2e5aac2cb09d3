"""The peaks that decide whether hands draw energy, of families of maps over a plane, with their slopes.

Takes: a `Family` of maps G(z) = C (z − A)⁻¹ B + E as matrices [[A, B], [C, E]], and a damping b.
Gives: `Peaks`.
Guarantees: as a `Deciding`: the height of a peak is below 1 exactly where G is positive real, and analytic
beyond where A ceases to be stable. No grid of frequencies decides anything.
Does not: say how much damping is needed (see `passivity`).

What is held by a damper b and moved from behind it scatters: S = (b − G)(b + G)⁻¹, and 1 − S*S =
4 b (b + G)⁻* He G (b + G)⁻¹. So G is positive real if and only if S is stable and σ, its largest gain at any
frequency, is at most 1. The needed damping itself grows without end where A ceases to be stable, often within
a hair of where hands begin to draw energy; S stays bounded there, as the damper holds what shakes.

A peak stands for an eigenvalue: σ e^{jθ}, with θ where it is. With F = (E + b)⁻¹, X = (z − A + B F C)⁻¹ B F
and T = F − F C X, S is 2 b T − 1, and dS = −2 b [F C (z − A + B F C)⁻¹, T] d[[A, B], [C, E]] [X; T].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import UNIT
from apc.regions.eigenpairs import ALIKE, Family, Pairs, by_system

Floats = NDArray[np.float64]
# Complex, as they come out of numpy, which forgets of how many digits.
Complexes = NDArray[Any]

# How far above what is known, relatively, a level is asked for, and how near the axis, relatively, an
# eigenvalue may be on it.
ABOVE, ON_AXIS = 1e-10, 1e-5

# Levels tried at a point: each step squares the distance.
LEVELS = 20

# Newton's steps to the top of a peak, and a step that is the last.
STEPS, SHORT = 8, 1e-7
FARTHEST, POLISHED = 0.3, 2

# Squares of gains nearer to each other than this turn into each other anyhow.
TWINS = 1e-13

# A peak this high decides: whether another is higher makes no difference.
BEYOND = 1.05

# Gains are told up to this: a resonance that doesn't die out has none.
MOST_GAIN = 1e2


# How far beside a pole, relatively, what is asked for at it is told.
BESIDE = 1e-14


@dataclass(frozen=True, slots=True, eq=False)
class _Loops:
    """Scattering of many maps: S = 2 b (F − F C (z − A_s)⁻¹ B F) − 1, one a point (k, …)."""

    a: Floats
    bf: Floats
    fc: Floats
    f: Floats
    b: float

    def at(self, places: NDArray[np.intp]) -> _Loops:
        """Return some of the points, more than once if wanted."""
        return _Loops(self.a[places], self.bf[places], self.fc[places], self.f[places], self.b)

    def x(self, angles: Floats) -> Complexes:
        """Return X at one angle a point (k, n, m)."""
        return _solved(self.inner(angles), self.bf + 0j)

    def s(self, x: Complexes) -> Complexes:
        """Return S (k, m, m) of X."""
        return np.asarray(2 * self.b * (self.f - self.fc @ x) - np.eye(self.f.shape[-1]))

    def gains(self, angles: Floats) -> Floats:
        """Return the largest gain (k, q) at angles (k, q)."""
        count, many = angles.shape
        every = self.at(np.repeat(np.arange(count), many))
        s = every.s(every.x(angles.ravel()))
        largest = np.linalg.eigvalsh(np.swapaxes(s, -1, -2).conj() @ s)[:, -1]
        return np.asarray(np.sqrt(np.maximum(largest, 0.0)).reshape(count, many))

    def inner(self, angles: Floats) -> Complexes:
        """Return z − A_s at one angle a point (k, n, n)."""
        return np.asarray(np.exp(1j * angles)[:, None, None] * np.eye(self.a.shape[-1]) - self.a)


@dataclass(frozen=True, slots=True, eq=False)
class Peaks:
    """A `Deciding` of maps: the `ports` of each are how many ways in, and out, it has, `damping` is b.

    The vectors of its pairs are what a change of [[A, B], [C, E]] is multiplied by to be that of σ.
    """

    family: Family
    ports: tuple[int, ...]
    damping: float
    strays: bool = True

    def log_magnitudes(self, matrices: Sequence[Floats], count: int) -> Floats:
        """Return the logarithms of the `count` highest peaks (k, count) of maps, one of each, descending."""
        found = np.stack([self._highest(s, one)[0] for s, one in enumerate(matrices)], axis=1)
        return np.asarray(np.log(-np.sort(-found, axis=1)[:, :count]))

    def leading(self, points: Floats) -> Pairs:
        """Return the highest peak of all maps at each point (k, 2)."""
        tops = [self._highest(s, one) for s, one in enumerate(self.family.matrices(points))]
        height, angle = (np.stack([one[place] for one in tops], axis=1) for place in (0, 1))
        # Of maps that are alike, one all along.
        system = np.argmax(height >= (1 - ALIKE) * height.max(axis=1, keepdims=True), axis=1)
        rows = np.arange(len(points))
        value = np.asarray(height[rows, system] * np.exp(1j * angle[rows, system]), np.complex128)
        nothing = np.zeros((len(points), max(self.family.sizes)), np.complex128)
        zeros = np.zeros((len(points), 2))
        return self.follow(points, Pairs(system, value, zeros.astype(np.complex128), zeros, nothing, nothing))

    def follow(self, points: Floats, guess: Pairs) -> Pairs:
        """Return at each point the peak of a map that a guess climbs to."""
        found = replace(guess, value=guess.value.copy(), slope=np.zeros((len(points), 2), np.complex128))
        right, left = np.zeros_like(guess.right), np.zeros_like(guess.left)
        for s, rows in by_system(guess.system):
            size = self.family.sizes[s]
            matrix, derivatives = self.family.slopes(s, points[rows])
            angles = np.abs(np.angle(guess.value[rows]))
            # A guess may lead to where there is no map: below a mass of 0, say.
            lost = ~(np.isfinite(matrix) & np.isfinite(derivatives).all(axis=0)).all(axis=(1, 2))
            lost |= ~np.isfinite(angles)
            matrix[lost], angles[lost] = 0.0, 0.0
            value, slope, w, v = self._climbed(s, matrix, derivatives, angles)
            found.value[rows], found.slope[rows] = np.where(lost, np.nan, value), slope
            left[rows, :size], right[rows, :size] = w, v
        gradient = (found.slope / found.value[:, None]).real
        return replace(found, gradient=gradient, right=right, left=left)

    def value_errors(self, pairs: Pairs) -> Floats:
        """Return by how much the heights (k,) may be off for what their maps are off, and for rounding."""
        found = np.zeros(len(pairs.value))
        for s, rows in by_system(pairs.system):
            size = self.family.sizes[s]
            w, v = np.abs(pairs.left[rows, :size]), np.abs(pairs.right[rows, :size])
            off = self.family.errors[s]
            found[rows] = ((w @ off) * v).sum(axis=1) + size * UNIT
        return found

    def _loops(self, system: int, matrix: Floats) -> _Loops:
        """Return the scattering of maps (k, n + m, n + m)."""
        n, m = matrix.shape[-1] - self.ports[system], self.ports[system]
        a, b, c, e = matrix[:, :n, :n], matrix[:, :n, n:], matrix[:, n:, :n], matrix[:, n:, n:]
        f = np.asarray(np.linalg.inv(e + self.damping * np.eye(m)), dtype=np.float64)
        bf: Floats = b @ f
        return _Loops(a - bf @ c, bf, f @ c, f, self.damping)

    def _highest(self, system: int, matrix: Floats) -> tuple[Floats, Floats]:
        """Return the height of the highest peak (k,) of each map and its angle; above 1 what isn't stable.

        Notes
        -----
        A level just above the highest that is known is reached where the Hamiltonian matrix of it has
        imaginary eigenvalues; between two of them it is higher (see `dissipation.peak_gain`).
        """
        loops = self._loops(system, matrix)
        values = np.linalg.eigvals(loops.a)
        slowest = np.take_along_axis(values, np.abs(values).argmax(axis=1)[:, None], axis=1)
        ends = np.tile([0.0, np.pi], (len(matrix), 1))
        angles = np.concatenate([ends, np.abs(np.angle(slowest))], axis=1)
        gains = loops.gains(angles)
        best, where = _largest(gains, angles)
        turn = gains[:, 0] < gains[:, 1]
        radius = np.abs(values).max(axis=1, initial=0.0)
        rest = np.flatnonzero(radius < 1)
        for _ in range(LEVELS):
            at = _on_circle(loops.at(rest), turn[rest], best[rest] * (1 + ABOVE))
            crossed = np.isfinite(at).any(axis=1)
            rest, at = rest[crossed], at[crossed]
            angles = _middles(at)
            height, angle = _largest(loops.at(rest).gains(angles), angles)
            higher = height > best[rest] * (1 + ABOVE)
            rest = rest[higher]
            if not len(rest):
                break
            best[rest], where[rest] = _polished(loops.at(rest), height[higher], angle[higher])
            rest = rest[best[rest] < BEYOND]
        return np.where(radius < 1, np.minimum(best, MOST_GAIN), np.maximum(radius, best)), where

    def _climbed(
        self, system: int, matrix: Floats, derivatives: Floats, angles: Floats
    ) -> tuple[Complexes, Complexes, Complexes, Complexes]:
        """Return the peak (k,) of each map next to an angle, its slopes (k, 2) and vectors (k, n + m)."""
        loops = self._loops(system, matrix)
        angle = angles
        for _ in range(STEPS):
            step = _at(loops, angle).step
            angle = _folded(angle + step)
            if (np.abs(step) <= SHORT).all():
                break
        at = _at(loops, angle)
        height = np.sqrt(at.squares[:, -1])
        v = at.vectors[:, :, -1:]
        turn = 1j * np.exp(1j * angle)[:, None, None]
        inner = np.swapaxes(loops.inner(angle), -1, -2)
        ends = [np.swapaxes(_solved(inner, np.swapaxes(loops.fc, -1, -2) + 0j), -1, -2)]
        ends.append(-turn * np.swapaxes(_solved(inner, np.swapaxes(ends[0], -1, -2)), -1, -2))
        # What a change of the map is multiplied by from both sides, and how that changes with θ.
        t, t_angle = loops.f - loops.fc @ at.x, -loops.fc @ at.x_angle
        left, right = np.concatenate([ends[0], t], axis=-1), np.concatenate([at.x, t], axis=-2)
        left_angle = np.concatenate([ends[1], t_angle], axis=-1)
        right_angle = np.concatenate([at.x_angle, t_angle], axis=-2)
        factor = -2 * self.damping
        outer = factor * np.swapaxes((at.s @ v).conj(), -1, -2) @ left / height[:, None, None]
        inside = right @ v
        slope = np.empty((len(angle), 2), np.complex128)
        for place, along in enumerate(derivatives):
            rise = (outer @ along @ inside)[:, 0, 0].real
            moved = along @ inside
            s_v = factor * left @ moved
            s_angle_v = factor * (left_angle @ moved + left @ (along @ (right_angle @ v)))
            s_x = factor * left @ along @ right
            turned = np.swapaxes(at.s, -1, -2).conj() @ s_v + np.swapaxes(s_x, -1, -2).conj() @ (at.s @ v)
            others = np.swapaxes(at.vectors, -1, -2).conj() @ turned
            mixed = 2 * (np.conj(at.s @ v) * s_angle_v + np.conj(at.s_angle @ v) * s_v).sum(axis=(1, 2)).real
            mixed += 2 * (at.mixing * others[:, :-1, 0]).sum(axis=1).real
            swing = np.where(at.bend == 0, 0.0, -mixed / np.where(at.bend == 0, 1.0, at.bend))
            slope[:, place] = np.exp(1j * angle) * (rise + 1j * height * swing)
        return height * np.exp(1j * angle), slope, outer[:, 0], inside[:, :, 0]


@dataclass(frozen=True, slots=True, eq=False)
class _Height:
    """The gain of maps at an angle each: σ² is the last of `squares` (k, m), with how it changes over θ.

    `vectors` (k, m, m) are those of S*S, `x_angle` and `s_angle` derivatives of X and S over θ, `mixing`
    (k, m − 1) what other directions mix into the last as θ grows; `rise`, `bend` are derivatives of σ².
    """

    x: Complexes
    x_angle: Complexes
    s: Complexes
    s_angle: Complexes
    squares: Floats
    vectors: Complexes
    mixing: Complexes
    rise: Floats
    bend: Floats

    @property
    def step(self) -> Floats:
        """Newton's step to the top; uphill, where that would lead into a valley."""
        newton = -self.rise / np.where(self.bend == 0, 1.0, self.bend)
        uphill = np.sign(self.rise) * np.abs(newton)
        return np.clip(np.where(self.bend < 0, newton, uphill), -FARTHEST, FARTHEST)


def _at(loops: _Loops, angle: Floats) -> _Height:
    """Return the gain at an angle each (k,)."""
    turn = 1j * np.exp(1j * angle)[:, None, None]
    inner = loops.inner(angle)
    x = _solved(inner, loops.bf + 0j)
    x_angle = -turn * _solved(inner, x)
    x_bend = 1j * x_angle - 2 * turn * _solved(inner, x_angle)
    s, s_angle, s_bend = loops.s(x), -2 * loops.b * loops.fc @ x_angle, -2 * loops.b * loops.fc @ x_bend
    adjoint = np.swapaxes(s, -1, -2).conj()
    squares, vectors = np.linalg.eigh(adjoint @ s)
    v = vectors[:, :, -1:]
    moved, turned, bent = s @ v, s_angle @ v, s_bend @ v
    half = adjoint @ turned + np.swapaxes(s_angle, -1, -2).conj() @ moved  # dH/dθ v
    others = (np.swapaxes(vectors, -1, -2).conj() @ half)[:, :, 0]
    gaps = squares[:, -1:] - squares[:, :-1]
    mixing = np.where(gaps > TWINS, others[:, :-1].conj() / np.where(gaps > TWINS, gaps, 1.0), 0.0)
    bend = 2 * (np.conj(moved) * bent + np.conj(turned) * turned).sum(axis=(1, 2)).real
    bend += 2 * (mixing * others[:, :-1]).sum(axis=1).real
    return _Height(x, x_angle, s, s_angle, squares, vectors, mixing, others[:, -1].real, bend)


def _largest(gains: Floats, angles: Floats) -> tuple[Floats, Floats]:
    """Return the largest of each row (k, q), and its angle."""
    place = np.argmax(gains, axis=1)
    rows = np.arange(len(gains))
    return gains[rows, place], angles[rows, place]


def _polished(loops: _Loops, best: Floats, where: Floats) -> tuple[Floats, Floats]:
    """Return the gain (k,) at the top of the peak next to an angle each, and where it is."""
    angle = where
    for _ in range(POLISHED):
        angle = _folded(angle + _at(loops, angle).step)
    height = loops.gains(angle[:, None])[:, 0]
    higher = height > best
    return np.where(higher, height, best), np.where(higher, angle, where)


def _folded(angle: Floats) -> Floats:
    """Return angles as those in [0, π] with the same cosine."""
    return np.asarray(np.abs((angle + np.pi) % (2 * np.pi) - np.pi))


def _on_circle(loops: _Loops, turn: NDArray[np.bool_], level: Floats) -> Floats:
    """Return the angles (k, q), in order, at which the gain of each map is a level (k,), NaN behind them.

    The level is larger than the gain at π, or at 0 of those to `turn`.

    Notes
    -----
    With z = (1 + s)/(1 − s), or of −A and −B, that end becomes the point at infinity.
    """
    count, n = loops.a.shape[:2]
    if not n:
        return np.full((count, 1), np.nan)
    unit = np.eye(n)
    sign = np.where(turn, -1.0, 1.0)[:, None, None]
    a, b = sign * loops.a, sign * loops.bf
    inverse, known = _inverse(unit + a)
    c, d = -2 * loops.b * loops.fc, 2 * loops.b * loops.f - np.eye(loops.f.shape[-1])
    a_c, b_c, c_c = inverse @ (a - unit), np.sqrt(2) * inverse @ b, np.sqrt(2) * c @ inverse
    d_c = d - c @ inverse @ b
    across = np.swapaxes(d_c, -1, -2)
    r, told = _inverse(level[:, None, None] ** 2 * np.eye(d_c.shape[-1]) - across @ d_c)
    known &= told  # a gain that is the same at all frequencies is at its level nowhere or everywhere
    a_h = a_c + b_c @ r @ across @ c_c
    lower = np.swapaxes(c_c, -1, -2) @ (np.eye(d_c.shape[-1]) + d_c @ r @ across) @ c_c
    whole = np.concatenate(
        [
            np.concatenate([a_h, b_c @ r @ np.swapaxes(b_c, -1, -2)], axis=-1),
            np.concatenate([-lower, -np.swapaxes(a_h, -1, -2)], axis=-1),
        ],
        axis=-2,
    )
    at = np.linalg.eigvals(whole)
    on = (np.abs(at.real) <= ON_AXIS * np.abs(at)) & (at.imag >= 0) & known[:, None]
    angles = 2 * np.arctan(at.imag)
    found = np.sort(np.where(on, np.where(turn[:, None], np.pi - angles, angles), np.nan), axis=1)
    return found[:, : max(int(on.sum(axis=1).max(initial=0)), 1)]


def _solved(matrices: Complexes, right: Complexes) -> Complexes:
    """Solve many systems (k, n, n); of one that is singular, at a pole itself, a hair beside it."""
    try:
        return np.asarray(np.linalg.solve(matrices, right))
    except np.linalg.LinAlgError:
        aside = BESIDE * np.abs(matrices).max(axis=(-2, -1), keepdims=True, initial=1.0)
        return np.asarray(np.linalg.solve(matrices + aside * np.eye(matrices.shape[-1]), right))


def _inverse(matrices: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the inverses of many matrices (k, n, n), and which of them have one; I for those without."""
    try:
        return np.asarray(np.linalg.inv(matrices), np.float64), np.ones(len(matrices), dtype=np.bool_)
    except np.linalg.LinAlgError:
        known = np.linalg.matrix_rank(matrices) == matrices.shape[-1]
        unit = np.eye(matrices.shape[-1])
        return np.asarray(np.linalg.inv(np.where(known[:, None, None], matrices, unit)), np.float64), known


def _middles(angles: Floats) -> Floats:
    """Return the middles (k, q) between 0 and angles (k, q) in order; 0 for those that are NaN."""
    before = np.concatenate([np.zeros((len(angles), 1)), angles[:, :-1]], axis=1)
    middle = (angles + before) / 2
    return np.asarray(np.where(np.isfinite(middle), middle, 0.0))
