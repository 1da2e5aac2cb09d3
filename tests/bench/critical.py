"""How long a critical value takes, and how far from the truth it is: `python -m tests.bench.critical`.

The truth is the same crossing by the secant method in 60 digits on the full map of all peers, event by event
by hand (`tests.bruteforce`), none of whose code is the project's. One BLAS thread; the first call of a
process and the median of many are told apart.

With longer and longer delays, each in a process of its own, beside what thirty lines by hand do without a
bound: over a gain, a sweep of frequencies counts how often the characteristic function goes around 0, at one
gain after another, and Newton's method ends it; over a delay, the eigenvalues of all peers at one delay after
another, up to the first that is unstable.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from fractions import Fraction
from functools import partial

import mpmath
import numpy as np

from apc.analysis.analysis import prepare
from apc.benchmark.timing import median_time, timed
from apc.compiler.compiled import CompiledSystem
from apc.compiler.pipeline import compile_topology
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.moments.network import unreliable
from apc.vary.critical import critical
from apc.vary.margins import Margins, margins
from apc.vary.over_network import network_margins
from apc.vary.sensitivity import sensitivities
from tests.bench.judge import NOISE, Judge, parser_of
from tests.bench.paper_scene import K_C
from tests.bruteforce import Scene, frame_matrices, frame_matrix
from tests.topologies import AVERAGE, MESH, ROOT, SCENES, compiled

DIGITS = 60

# Frames that packets are late, and how far a delay is searched; what the longest may take.
FRAMES, UPPER = (1, 10, 30, 100, 300), ("200 ms", "2 s")
LONGEST_S, LONGEST_MB, DELAY_S, MARGINS_S = 0.5, 150.0, 2.0, 0.03

# Of a sweep by hand: points a turn of ζ^(−d), gains, halvings between two of them, places of each loop from
# which Newton's method starts, and its steps.
POINTS, GAINS, HALVINGS, STARTS, NEWTON = 24, np.geomspace(1.0, 3000.0, 25), 8, 4, 8

Floats = np.ndarray[tuple[int, ...], np.dtype[np.float64]]
Complexes = np.ndarray[tuple[int, ...], np.dtype[np.complex128]]


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


def _alone(k_t: float) -> tuple[Floats, Floats, Floats]:
    """Return P, Q and S of one peer over a frame: of two who hear each other a frame late."""
    full = frame_matrices(Scene(peers=2, kt=k_t, kc=K_C), 1)[0]
    size = len(full) // 2
    first = size - 4  # of four packets x and v, the newest first, and older ones nobody hears
    return full[:first, :first], full[:first, size + first : 2 * size], full[first:size, :first]


def _loop(k_t: float, frames: int, weight: float, points: Complexes) -> Complexes:
    """Return det(ζ − P − w ζ^(−d) Q S) of three peers, all alike (w = 1) or apart (−1/2)."""
    p, q, s = _alone(k_t)
    late = (weight * points**-frames)[:, None, None] * (q @ s)
    return np.asarray(np.linalg.det(points[:, None, None] * np.eye(len(p)) - p - late))


def gain_by_hand(frames: int) -> float:
    """Return the critical stiffness of a scheme AP whose packets are so many frames late."""
    angles = np.linspace(0, np.pi, POINTS * (frames + 10))[1:]
    angles = np.concatenate([np.geomspace(1e-7, angles[0], 400)[:-1], angles])
    points = np.exp(1j * angles)

    def swept(k_t: float) -> list[Complexes]:
        alike, apart = (_loop(k_t, frames, weight, points) for weight in (1.0, -0.5))
        return [alike / (1 - 1 / points), apart]  # all can move together

    def stable(k_t: float) -> bool:
        turned = [float(np.angle(f[1:] / f[:-1]).sum()) for f in swept(k_t)]
        return all(round(one / np.pi) >= len(_alone(k_t)[0]) for one in turned)

    high = next(place for place, k_t in enumerate(GAINS) if not stable(k_t))
    low, top = float(GAINS[high - 1]), float(GAINS[high])
    for _ in range(HALVINGS):
        middle = (low + top) / 2
        low, top = (middle, top) if stable(middle) else (low, middle)
    found = []
    for weight, f in zip((1.0, -0.5), swept(low), strict=True):
        sizes = np.abs(f) / np.maximum(np.abs(np.gradient(f, angles)), 1e-300)
        starts = angles[np.argsort(sizes)[:STARTS]].tolist()
        found += [_crossing(frames, weight, angle, low) for angle in starts]
    return min(k_t for k_t in found if abs(k_t - low) < 0.1 * low)


def _crossing(frames: int, weight: float, angle: float, k_t: float) -> float:
    """Return the stiffness of an eigenvalue on the circle, by Newton's method."""
    at, step = np.array([angle, k_t]), 1e-6

    def value(angle: float, k_t: float) -> complex:
        return complex(_loop(k_t, frames, weight, np.array([np.exp(1j * angle)]))[0])

    for _ in range(NEWTON):
        here, moved = value(*at), (value(at[0] + step / frames, at[1]), value(at[0], at[1] * (1 + step)))
        slopes = (moved[0] - here) * frames / step, (moved[1] - here) / (at[1] * step)
        jacobian = np.array([[one.real for one in slopes], [one.imag for one in slopes]])
        at = at - np.linalg.solve(jacobian, [here.real, here.imag])
    return float(at[1])


def delay_by_hand(upper: float) -> float | None:
    """Return the first delay, in seconds, from which on scheme AP is unstable."""
    for place in range(round(upper * 1000)):
        late = Scene(kc=K_C, comm=Fraction(2 * place + 1, 2000))
        sizes = np.sort(np.abs(np.linalg.eigvals(frame_matrices(late, 1)[0])))
        if sizes[-2] > 1:  # all can move together
            return place / 1000
    return None


def _one(name: str, late: str, upper: str) -> None:
    """Print what one critical value is and takes, and what the process holds more than before it."""
    system = apply(compiled(AVERAGE), [Override(Free("lan.delay"), Fraction(late))])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.process_time()
    found = critical(system, name, upper=upper or None)
    seconds = time.process_time() - start
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    scale = 2.0**20 if sys.platform == "darwin" else 2.0**10
    print(json.dumps([found.value, found.error, seconds, most / scale, (most - before) / scale]))


def _apart(name: str, late: Fraction, upper: str) -> tuple[float, float, float, float, float]:
    """Return the value, its error, the seconds, and the megabytes of a process and of the call."""
    words = [sys.executable, "-m", "tests.bench.critical", "--one", name, str(late), upper]
    told = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    value, error, seconds, most, more = json.loads(told)
    return value, error, seconds, most, more


def delays(judge: Judge) -> None:
    """Print a line a delay, and a line a range of delays, beside what is done by hand."""
    print("\ncritical coordination.stiffness        seconds   MB  more   error   by hand  ratio  apart")
    for frames in FRAMES:
        value, error, seconds, most, more = _apart("coordination.stiffness", Fraction(frames, 125), "")
        hand, own = timed(partial(gain_by_hand, frames))
        apart = abs(own - value) / value
        work = f"critical coordination.stiffness, {frames} frames late"
        ours = seconds, f"≤ {error / value:.0e}"
        judge.beside(work, ours, "sweep of frequencies, Newton", (hand, f"{apart:.0e} apart"))
        print(
            f"  {frames:>4} frames late {value:19.10f} {seconds:8.3f} {most:5.0f} {more:5.0f} "
            f"{error / value:8.0e} {hand:8.3f} {seconds / hand:6.2f} {apart:7.0e} "
            f"{judge.right(f'{frames} frames, by hand', apart < 1e-8)}"
        )
    for what, one, target, noise in (
        ("seconds", seconds, LONGEST_S, NOISE),
        ("megabytes", most, LONGEST_MB, 1.0),
    ):
        print(f"    {what} of the longest: {judge.in_time(f'{frames} frames, {what}', one, target, noise)}")
    print("critical lan.delay")
    for upper in UPPER:
        value, error, seconds, most, more = _apart("lan.delay", Fraction(1, 125), upper)
        reach = float(upper.split()[0]) / (1000 if "ms" in upper else 1)
        hand, first = timed(partial(delay_by_hand, reach))
        work, ours = f"critical lan.delay up to {upper}", (seconds, f"≤ {error:.0e} s")
        judge.beside(work, ours, "eigenvalues at each delay", (hand, "same delay"))
        print(
            f"  up to {upper:<9} {value:19.10f} {seconds:8.3f} {most:5.0f} {more:5.0f} {error:8.0e} "
            f"{hand:8.3f} {seconds / hand:6.2f}         {judge.right(f'{upper}, by hand', first == value)}"
        )
    print(f"    seconds of the longest: {judge.in_time(f'lan.delay to {upper}', seconds, DELAY_S)}")


def main() -> None:
    """Print a line a scheme, a delay and a range of delays, and what margins and sensitivities take."""
    parser = parser_of("critical", __doc__)
    parser.add_argument("--repeat", type=int, default=20, help="runs of which the median counts")
    parser.add_argument("--one", nargs=3, help="what varies, the link's delay in s, up to where: print that")
    given = parser.parse_args()
    if given.one:
        _one(*given.one)
        return
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
    delays(judge)
    of_scenes(judge)
    judge.end()


def of_scenes(judge: Judge) -> None:
    """Print a line a scene: what its margins take the first time and later, over its network as well."""
    print("\nmargins of every scene             first median")
    for path in sorted(SCENES.glob("*.yaml")):
        scene = compile_topology(path)
        ways: dict[str, Callable[[], Margins]] = {path.stem: partial(margins, scene)}
        if unreliable(scene):
            ways[f"{path.stem}, in mean square"] = partial(
                network_margins, scene, prepare(scene), margins(scene)
            )
        for name, call in ways.items():
            first, _ = timed(call)
            seconds, _ = median_time(call, 3)
            kept = judge.in_time(f"margins of {name}", seconds, MARGINS_S)
            print(f"  {name:<32} {first * 1e3:6.1f} {seconds * 1e3:6.1f} ms  {kept}")


if __name__ == "__main__":
    main()
