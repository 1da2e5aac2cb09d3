"""Sensitivities of random topologies against 320-bit arithmetic, and frequencies beside their eigenvalues.

`run` draws topologies of the built-in library (`bench.shapes`); `check_sensitivities` and `check_frequencies`
serve any topology. The truth of derivatives comes from the compiled functions alone, event by event
(`fifty_digits.events`): from frame matrices on either side of a value.
"""

from __future__ import annotations

import cmath
import contextlib
import itertools
import math
import random
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any

import flint
import numpy as np

from apc.analysis.analysis import Analysis, analyze
from apc.compiler.compiled import Model
from apc.lifting.numeric_model import numeric_model
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import find, parameter_of
from apc.spectrum.ball_arithmetic import precision
from apc.studies.sensitivity import Sensitivities, sensitivities
from tests.bench.shapes import PARTS, draw_shape
from tests.fifty_digits.events import Happening, build_peers, refusal
from tests.fifty_digits.truth import RIGID, _common_whom, _difference_whom, _from_state, _to_state, classes_of
from tests.topologies import compiled

BITS = 320

# A value is moved by so much of it: what a central difference cuts off is 1e-18 of the derivative.
STEP = 2.0**-30

# Eigenvalues of the truth this near to one that is said are it, or stand in one cluster with it.
SAME = 1e-9

# Eigenvalues of the truth that differ by more differ.
SEPARATE = 1e-30

# What rounding may do to a derivative, of which three digits are printed, relative to it and to the radius,
# at least so much, over the value: as many digits are lost as the condition of its eigenvalue has.
ROUNDED, LEAST = 1e-7, 1e-3

# What is left of modes smaller than this at a frame's end drowns; radians that an angle may be off by.
FADED, TURNED = 1e-9, 1e-3


def topology(generator: random.Random) -> str:
    """Return a topology of the built-in library at random, in which something may be unstable."""
    own = tuple(f"type: {name}" for name in PARTS)
    texts = (draw_shape(generator).text for _ in itertools.count())
    return next(text for text in texts if not any(name in text for name in own))


def check_sensitivities(model: Model, found: Analysis | Sensitivities) -> str:
    """Return what is wrong with the derivatives of a topology's spectral radius, "" if nothing is.

    Of an analysis the radius is compared with theirs.
    """
    printed = found if isinstance(found, Sensitivities) else sensitivities(numeric_model(model))
    if isinstance(found, Analysis) and printed.active:
        apart = abs(printed.radius - found.spectral_radius)
        if not apart <= 1e-9 + found.spectral_radius_error:
            return f"the radius is {found.spectral_radius}, that of the derivatives {printed.radius}"
    if refusal(model, in_time=False) or not printed.active:
        return ""
    with precision(BITS):
        here = _matrices(model)
        radius = max((float(abs(v)) for m in here for v in _values(m) if not _is_rigid(v)), default=0.0)
        if abs(radius - printed.radius) > SAME * max(1.0, radius):
            return f"the radius of the derivatives is {printed.radius}, truth {radius}"
        tops = [_top(here, value) for value, _ in printed.active]
        if any(not top for top in tops):
            return "an eigenvalue that is differentiated is none of the topology"
        moved: dict[str, list[Any]] = {}
        for row in printed.rows:
            if row.parameter not in moved:
                moved[row.parameter] = _slopes(model, here, row.parameter)
            truths = [rate for top in tops[row.mode] for rate in _rates(top, moved[row.parameter])]
            nearest, most = min(truths, key=lambda rate: abs(row.derivative - rate)), max(map(abs, truths))
            allowed = ROUNDED * (most + max(radius, LEAST) / abs(row.value or 1.0))
            if not abs(row.derivative - nearest) <= allowed:
                return f"d|λ|/d {row.parameter} of mode {row.mode + 1} is {row.derivative}, truth {nearest}"
    return ""


def _matrices(model: Model) -> list[Any]:
    """Return the frame matrices of all closed systems."""
    frame = numeric_model(model).schedules[0].frame_s
    return [_whole_map(one, frame) for one in _happenings(model)]


def _values(matrix: Any) -> list[Any]:
    return [
        v.mid()
        for v in flint.acb_mat(matrix.mid()).eig(algorithm="approx", maxiter=flint.ctx.prec * matrix.nrows())
    ]


def _is_rigid(value: Any) -> bool:
    return bool(float(abs(value - 1).mid()) < RIGID)


def _top(here: Sequence[Any], value: complex) -> list[tuple[int, list[Any], Any, Any]]:
    """Return the clusters at a value: the system's place, the eigenvalues, their vectors W and V, W V = 1.

    Where several eigenvalues stand there but not in one place, each is one by itself as well.
    """
    found = []
    for place, matrix in enumerate(here):
        middle = flint.acb_mat(matrix.mid())
        values = _values(matrix)
        reach = SAME * max(1.0, abs(value))
        own = [one for one in values if not _is_rigid(one) and abs(complex(one) - value) < reach]
        groups = [own] if own else []
        if any(float(abs(one - own[0])) > SEPARATE for one in own):
            groups += [[one] for one in own]
        for group in groups:
            with contextlib.suppress(ZeroDivisionError):  # W V of a defective cluster has no inverse
                found.append((place, group, *_vectors(middle, group)))
    return found


def _vectors(matrix: Any, own: Sequence[Any]) -> tuple[Any, Any]:
    """Return left and right vectors of a cluster, W V = 1, by inverse iteration."""
    n, c = matrix.nrows(), len(own)
    centre = sum(own, flint.acb(0)) / c
    shifted = matrix - (centre + flint.acb(2) ** -(BITS // 2)) * _unit(n)
    generator = random.Random(n)
    start = flint.acb_mat(n, c, [flint.acb(generator.uniform(-1, 1)) for _ in range(n * c)])
    right, left = start, start
    for _ in range(4):
        right = _scaled(shifted.solve(right, algorithm="approx"))
        left = _scaled(shifted.transpose().solve(left, algorithm="approx"))
    w = left.transpose()
    return (w * right).inv() * w, right


def _unit(n: int) -> Any:
    return flint.acb_mat(n, n, [flint.acb(i == j) for i in range(n) for j in range(n)])


def _scaled(matrix: Any) -> Any:
    size = max(float(abs(entry)) for entry in matrix.entries())
    return matrix * (flint.acb(1) / flint.acb(size))


def _slopes(model: Model, here: Sequence[Any], name: str) -> list[Any]:
    """Return the derivatives of all frame matrices by a parameter, set as `--set` does."""
    free = find(model, name)
    value = parameter_of(model, free).value

    def at(number: float) -> list[Any]:
        moved = _matrices(apply(model, [Override(free, Fraction(number))]))
        return [flint.acb_mat(matrix.mid()) for matrix in moved]

    if value:
        low, high = value * (1 - STEP), value * (1 + STEP)
        return [
            (b - a) * (flint.acb(1) / (flint.acb(high) - flint.acb(low)))
            for a, b in zip(at(low), at(high), strict=True)
        ]
    still = [flint.acb_mat(matrix.mid()) for matrix in here]
    near, far = at(STEP**2), at(2 * STEP**2)
    one = flint.acb(1) / flint.acb(2 * STEP**2)
    return [(4 * b - 3 * a - c) * one for a, b, c in zip(still, near, far, strict=True)]


def _rates(top: tuple[int, list[Any], Any, Any], slopes: Sequence[Any]) -> list[float]:
    """Return how fast the magnitudes of a cluster grow."""
    place, own, w, v = top
    rate = w * slopes[place] * v
    c = len(own)
    moves = (
        [rate[0, 0]] if c == 1 else [one.mid() for one in flint.acb_mat(rate.mid()).eig(algorithm="approx")]
    )
    return [float(((value.conjugate() * move) / abs(value)).real.mid()) for value in own for move in moves]


def check_frequencies(found: Analysis) -> str:
    """Return what is wrong with frequencies and damping of modes, "" if nothing is.

    λ = e^{sT}, s = ln|λ|/T + 2πjf, and the damping ratio is −Re s/|s|. How often it turns besides, which λ
    does not tell, is not looked at.
    """
    for mode in found.modes:
        if not math.isfinite(mode.frequency_hz) or mode.magnitude < max(FADED, 2 * mode.error):
            continue
        rate = complex(math.log(mode.magnitude), 2 * math.pi * mode.frequency_hz * found.frame_s)
        off = min(abs(cmath.exp(one) - mode.eigenvalue) for one in (rate, rate.conjugate()))
        damping = -rate.real / abs(rate) if rate else 1.0
        if off > mode.error + TURNED * mode.magnitude or abs(mode.damping_ratio - damping) > 1e-6:
            return f"mode {mode.eigenvalue}: {mode.frequency_hz} Hz, damping {mode.damping_ratio}"
    return ""


def _happenings(model: Model) -> Iterator[Happening]:
    """Yield the common motion, and each class's differences, as peers to follow."""
    classes = classes_of(model)
    subsystems = build_peers(model, classes.peers, classes.groups, linear=True)
    yield Happening(model, subsystems, _common_whom(subsystems, classes))
    for place, count in enumerate(classes.counts):
        if count > 1:
            yield Happening(model, [subsystems[place]], _difference_whom(subsystems, classes, place))


def _whole_map(topology: Happening, frame: Fraction) -> Any:
    """Return the map of one frame over all states."""
    n = sum(len(subsystem.names) for subsystem in topology.subsystems)
    play = _from_state(topology, list(np.eye(n, dtype=int).astype(object)))
    topology.play(play, Fraction(0), frame)
    rows = [np.broadcast_to(np.asarray(row, dtype=object), n) for row in _to_state(topology, play)]
    return flint.arb_mat(n, n, [flint.arb(entry) for row in rows for entry in row])


def run(points: int, *, seed: int = 0) -> list[str]:
    """Check so many random topologies; return what is wrong, with each topology's text."""
    generator, wrong = random.Random(seed), []
    for _ in range(points):
        text = topology(generator)
        model = compiled(text)
        found = analyze(numeric_model(model))
        wrong += [
            f"{one}\n{text}" for one in (check_sensitivities(model, found), check_frequencies(found)) if one
        ]
    return wrong
