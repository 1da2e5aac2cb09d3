"""The map of the paper's scene over K_C and K_T, every verdict against 60 digits: `python -m tests.bench.map`.

Four maps: P (no damping in the couplers) and PD (2 N·s/m), mean and mesh; then the points at the boundary of
each column times 1 ± 1e-9. Wrong verdicts must be none; an error beside its bound must be below 1.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import flint
import numpy as np

import apc
from apc.benchmark.timing import timed
from apc.eigen.balls import precision
from tests.bench.by_hand import CUBE_DAMPING, DEVICE_DAMPING, DEVICE_MASS, SHARED_MASS, TICKS, USERS
from tests.bench.judge import Judge, judged, parser_of
from tests.bruteforce import Scene, as_ball, frame_matrix
from tests.topologies import AVERAGE, MESH, compiled

BITS = 200  # of precision: 60 decimal digits
CERTAIN = 1e-40  # so far, and no more, the truth itself may be off (`check_truth`)
MOST_K_C, MOST_K_T = 5000.0, 1500.0  # the limits of the scene's own study; with dampers, twice that holds
DEVICE, CUBE = Fraction(DEVICE_MASS), Fraction(SHARED_MASS) / USERS  # the numbers a compiled scene holds


@dataclass(frozen=True)
class Truth:
    """All eigenvalues of a point, and the radius without the one that is 1."""

    values: list[flint.acb]
    radius: flint.arb


def truth(mesh: bool, k_c: float, k_t: float, damping: float) -> Truth:
    """Return the truth at a point, by propagating one user who hears its own packets times an eigenvalue of W."""
    own = 2 if mesh else 1
    values: list[flint.acb] = []
    radius = flint.arb(0)
    for share, rigid in ((flint.arb(own), True), (-flint.arb(own) / 2, False)):
        matrix = _frame(own, share, flint.arb(k_c), flint.arb(k_t), flint.arb(damping))
        found = flint.acb_mat(matrix.mid()).eig(algorithm="approx")
        found.sort(key=lambda value: float(abs(value - 1).mid()))
        values += found
        assert not rigid or float(abs(found[0] - 1).mid()) < CERTAIN
        radius = max([radius, *(abs(value).mid() for value in found[1 if rigid else 0 :])])
    return Truth(values, radius)


@functools.cache
def _step() -> Any:
    """Return e^(A T) (6, 6) of a tick, over (x, v, x_O, v_O, F_C, F_T) with the forces held."""
    device, cube, zero = Fraction(DEVICE_DAMPING) / DEVICE, Fraction(CUBE_DAMPING) / CUBE, Fraction(0)
    rates = [[zero] * 6 for _ in range(6)]
    rates[0][1] = rates[2][3] = Fraction(1)
    rates[1][1], rates[1][4] = -device, -1 / DEVICE
    rates[3][3:6] = -cube, 1 / CUBE, -1 / CUBE
    return flint.arb_mat(6, 6, [as_ball(one / 1000) for row in rates for one in row]).exp()


def _frame(own: int, share: Any, k_c: Any, k_t: Any, damping: Any) -> Any:
    """Return one user's frame over (x, v, x_O, v_O, F_C, F_T, packet x_O, packet v_O)."""
    tick, step = flint.arb_mat(8, 8), _step()
    for row in range(4):
        for column in range(6):
            tick[row, column] = step[row, column]
    for column, value in enumerate((k_c, damping, -k_c, -damping)):
        tick[4, column] = value
    for column, value in enumerate((own * k_t, own * damping)):
        tick[5, 2 + column], tick[5, 6 + column] = value, -share * value / own
        tick[6 + column, 6 + column] = flint.arb(1)
    frame = tick**TICKS
    for column in range(8):
        frame[6, column], frame[7, column] = flint.arb(column == 2), flint.arb(column == 3)
    return frame


def check_truth() -> None:
    """Assert that the truth of one user is that of three, event by event."""
    for mesh in (False, True):
        scene = Scene(operator="sum" if mesh else "mean", kc=1500.0, kt=800.0, bt=2.0, bc=2.0, cube=CUBE)  # type: ignore[arg-type] # any number will do
        rows = frame_matrix(scene, number=as_ball, exp=lambda value: value.exp())
        whole = flint.acb_mat([[flint.acb(e.mid()) for e in row] for row in rows]).eig(algorithm="approx")
        whole.sort(key=lambda value: float(abs(value - 1).mid()))
        radius = max(abs(value).mid() for value in whole[1:])
        assert float(abs(radius - truth(mesh, 1500.0, 800.0, 2.0).radius)) < CERTAIN


def compared(judge: Judge, name: str, mesh: bool, damping: float, points: list[tuple[float, float]]) -> None:
    """Compare the analyses of some points with their truth, all eigenvalues of the first fifty too."""
    system = compiled(MESH if mesh else AVERAGE)
    k_c, k_t = np.array(points).T
    dampers = {f"{one}.damping": f"{damping} N*s/m" for one in ("contact", "coordination")}
    system = apc.set_parameters(system, dampers)
    given = {"contact.stiffness": k_c, "coordination.stiffness": k_t}
    seconds, results = timed(lambda: apc.analyze_many(system, given))
    truths = [truth(mesh, x, y, damping) for x, y in points]
    off = [
        abs(one.radius - flint.arb(rho)).mid()
        for one, rho in zip(truths, results.spectral_radius, strict=True)
    ]
    ratio = max(float(one) / bound for one, bound in zip(off, results.spectral_radius_error, strict=True))
    wrong = sum(ours != bool(one.radius < 1) for ours, one in zip(results.stable, truths, strict=True))
    worst = 0.0
    for (x, y), known in list(zip(points, truths, strict=True))[:: max(1, len(points) // 50)]:
        values = {"contact.stiffness": f"{x!r} N/m", "coordination.stiffness": f"{y!r} N/m"}
        for mode in apc.analyze(system, set=values).modes:
            place = flint.acb(mode.eigenvalue.real, mode.eigenvalue.imag)
            distance = min(float(abs(place - value).mid()) for value in known.values)
            worst = max(
                worst, 0.0 if distance <= CERTAIN else distance / mode.error if mode.error else math.inf
            )
    print(
        f"{name:<22} {len(points):6} points  {wrong} wrong  error/bound {ratio:.2g} (radius) {worst:.2g} (modes)  "
        f"largest bound {results.spectral_radius_error.max():.1e}  {1e3 * seconds / len(points):.2f} ms a point",
        flush=True,
    )
    judge.right(f"{name}: {wrong} verdicts wrong or left open", not wrong)
    judge.within(f"{name}: error of the radius / bound", ratio, 1)
    judge.within(f"{name}: error of a mode / bound", worst, 1)


def boundary(mesh: bool, damping: float, k_c: float, heights: list[float]) -> list[tuple[float, float]]:
    """Return the points next to where the verdict changes over a value of K_C."""

    def stable(k_t: float) -> bool:
        return bool(truth(mesh, k_c, k_t, damping).radius < 1)

    points = []
    verdicts = [stable(one) for one in heights]
    for place in np.flatnonzero(np.diff(verdicts)).tolist():
        low, high = heights[place], heights[place + 1]
        while high - low > 1e-12 * high:
            middle = (low + high) / 2
            low, high = (middle, high) if stable(middle) == verdicts[place] else (low, middle)
        points += [(k_c, low * (1 - 1e-9)), (k_c, low * (1 + 1e-9))]
    return points


def main() -> None:
    """Print two lines a map."""
    parser = parser_of("map", __doc__)
    parser.add_argument("--points", type=int, default=10_000, help="of all four maps together")
    with judged(parser) as (judge, given), precision(BITS):
        side = max(2, math.isqrt((400 if given.quick else given.points) // 4))
        check_truth()
        for mesh in (False, True):
            for damping in (0.0, 2.0):
                name = f"{'mesh' if mesh else 'mean'} {'PD' if damping else 'P'}"
                across = (MOST_K_C * (np.arange(side) + 1) / side).tolist()
                up = ((2 if damping else 1) * MOST_K_T * (np.arange(side) + 1) / side).tolist()
                compared(judge, name, mesh, damping, [(x, y) for x in across for y in up])
                edge = [one for x in across for one in boundary(mesh, damping, x, up)]
                compared(judge, f"{name}, boundary", mesh, damping, edge)


if __name__ == "__main__":
    main()
