"""How long a critical value takes, and how far from the truth it is: `python -m tests.bench.critical`.

The truth is the same crossing by the secant method in 60 digits on the full map of all peers, event by event
by hand (`tests.bruteforce`), none of whose code is the project's. One BLAS thread; the first call of a
process and the median of many are told apart.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import mpmath

from apc.benchmark.timing import median_time, timed
from apc.compiler.compiled import CompiledSystem
from apc.vary.critical import critical
from apc.vary.margins import margins
from apc.vary.sensitivity import sensitivities
from tests.bench.judge import Judge, parser_of
from tests.bench.paper_scene import K_C
from tests.bruteforce import Scene, frame_matrix
from tests.topologies import AVERAGE, MESH, compiled

DIGITS = 60


def _eigenvalue(scene: Scene, guess: mpmath.mpc) -> mpmath.mpc:
    """Return the eigenvalue of the full map nearest to a guess."""
    matrix = mpmath.matrix(frame_matrix(scene, number=mpmath.mpf, exp=mpmath.exp))
    n = matrix.rows
    vector = mpmath.matrix([mpmath.mpc(1, place % 3) / (1 + place) for place in range(n)])
    value = guess * (1 + mpmath.mpf("1e-8"))
    for step in range(12):
        try:
            vector = mpmath.lu_solve(matrix - value * mpmath.eye(n), vector)
        except ZeroDivisionError:  # the value is an eigenvalue to the last digit
            return value
        place = max(range(n), key=lambda row: abs(vector[row]))
        vector = vector / vector[place]
        after = (matrix[place, :] * vector)[0]
        if step > 1 and abs(after - value) < mpmath.mpf(10) ** (8 - DIGITS):
            return after
        value = after if step > 1 else value
    return value


def truth(operator: str, start: float, frequency: float) -> mpmath.mpf:
    """Return the stiffness at which |λ| = 1, by the secant method."""
    guess = mpmath.exp(2j * mpmath.pi * mpmath.mpf(frequency) * mpmath.mpf("0.008"))

    def growth(k_t: mpmath.mpf) -> mpmath.mpf:
        return abs(_eigenvalue(Scene(operator=operator, kt=k_t, kc=mpmath.mpf(K_C)), guess)) - 1

    one, other = mpmath.mpf(start), mpmath.mpf(start) * (1 + mpmath.mpf("1e-9"))
    f_one, f_other = growth(one), growth(other)
    for _ in range(6):
        one, f_one, other = other, f_other, other - f_other * (other - one) / (f_other - f_one)
        f_other = growth(other)
        if abs(other - one) < abs(one) * mpmath.mpf("1e-30"):
            break
    return other


def main() -> None:
    """Print a line a scheme, and what margins and sensitivities take."""
    parser = parser_of("critical", __doc__)
    parser.add_argument("--repeat", type=int, default=20, help="runs of which the median counts")
    given = parser.parse_args()
    judge = Judge(given.strict)
    print("critical coordination.stiffness      first median    value              relative error  bound")
    for scheme, text, operator in (("AP", AVERAGE, "mean"), ("VC", MESH, "sum")):
        system = compiled(text)
        call = partial(critical, system, "coordination.stiffness")
        first, _ = timed(call)
        seconds, found = median_time(call, given.repeat)
        assert found.value is not None
        assert found.error is not None
        with mpmath.workdps(DIGITS):
            exact = truth(operator, found.value, found.crossings[0].frequency_hz)
            off = float(abs(exact - mpmath.mpf(found.value)) / exact)
        bound = found.error / found.value
        print(
            f"  {scheme:<32} {first * 1e3:6.1f} {seconds * 1e3:6.1f} ms {found.value:.13f} "
            f"{off:10.1e} {bound:14.1e}  {judge.within(f'{scheme}, critical', off, bound)}"
        )
    system = compiled(AVERAGE)
    calls: tuple[tuple[str, Callable[[CompiledSystem], object]], ...]
    calls = (("margins", margins), ("sensitivities", sensitivities))
    for name, of_system in calls:
        first, _ = timed(partial(of_system, system))
        seconds, _ = median_time(partial(of_system, system), max(3, given.repeat // 4))
        print(f"  {name:<32} {first * 1e3:6.1f} {seconds * 1e3:6.1f} ms")
    judge.end()


if __name__ == "__main__":
    main()
