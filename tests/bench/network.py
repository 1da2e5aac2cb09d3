"""Verdicts over networks that lose packets, error beside time: `python -m tests.bench.network`.

The opponent is written by hand: the paper's users and what each hears of each in one matrix a pattern of
losses (`tests.held_scenes`), second moments moved by all of them, A ⊗ A times the pattern's chance, the
largest eigenvalue by LAPACK; under bursts one such matrix a state of all channels, by ARPACK. Times are CPU
seconds, of a compiled and once analysed scene: what is added to the nominal answer.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance, null_space
from scipy.sparse.linalg import LinearOperator, eigs

from apc import prove_box
from apc.analysis.analysis import prepare
from apc.benchmark.timing import median_time, timed
from apc.moments.almost_sure import COURSES, FRAMES, almost_sure
from apc.moments.network import Growth, growth
from apc.regions.axes import parse_axes
from apc.regions.region import Region, region
from apc.threads import single_threaded
from tests.bench.judge import Judge, parser_of
from tests.held_scenes import frames, scene, system_of

Floats = NDArray[np.float64]

STIFFNESS, LOSS = 1100.0, 0.1
BURSTS = 0.02, 0.1  # from good to bad, and back: bursts of ten packets, a sixth of all
PEERS, MANY, TAGGED = 3, 10**6, 5
FEW_STIFFNESS, WIDTHS = 800.0, (0.02, 0.1, 0.3, 0.5)  # of boxes

# Seconds: of what is independent, of a curve, of bursts by all moments, and by those of orders 2 and 3. A
# million users may take so many times what three do.
INDEPENDENT_S, CURVE_S, BURSTS_S, TAGGED_S, MILLION = 0.005, 1.0, 2.0, 30.0, 1.5

# What eigenvalues of hundreds of rows by LAPACK are right to, and those of thousands by ARPACK or, where most
# packets are lost, by LAPACK; vectors it keeps.
EXACT, ITERATED, KRYLOV = 1e-8, 1e-7, 60

# Of intervals of 95 %, how many must hold the truth: fewer than this is chance in one of ten thousand.
LEAST_HELD = 0.86

CURVE = "lan.loss=0:0.6", "coordination.stiffness=1000 N/m:2000 N/m"
LOOKED = 5  # points of a curve that are asked of the opponent

# Courses by hand, frames of each, and those that go before; how far apart two estimates may be, in half
# widths of their intervals of 95 %: further is chance in one of a million.
COURSES_BY_HAND, COURSE, SETTLING, FAR = 200, 5000, 2000, 2.5


def matrices(peers: int, stiffness: float) -> tuple[Floats, Floats]:
    """Return the matrices (2^c, n, n) of every pattern (2^c, c) of channels that hear, translations out."""
    whole = frames(peers, stiffness)
    patterns = np.array(list(itertools.product((0.0, 1.0), repeat=len(whole.pairs))))
    together = null_space(whole.matrix(patterns[-1]) - np.eye(len(whole.matrix(patterns[-1]))), rcond=1e-9)
    apart = null_space(together.T)
    each = np.array([apart.T @ whole.matrix(one) @ apart for one in patterns])
    scales = matrix_balance(each.mean(axis=0), permute=False, separate=True)[1][0]  # of m, m/s and N
    return each * scales / scales[:, None], patterns


def by_hand(peers: int, stiffness: float, loss: float) -> float:
    """Return the growth of second moments a frame, every pattern of losses written out."""
    each, patterns = matrices(peers, stiffness)
    chances = np.where(patterns, 1 - loss, loss).prod(axis=1)
    squares = sum(chance * np.kron(one, one) for chance, one in zip(chances, each, strict=True))
    return float(np.abs(np.linalg.eigvals(squares)).max())


def bursts_by_hand(peers: int, stiffness: float, p: float, r: float) -> float:
    """Return the same where channels turn bad by p and good again by r, their states followed one by one."""
    each, patterns = matrices(peers, stiffness)
    count, n = each.shape[:2]
    turns = np.array([[1 - r, r], [p, 1 - p]])  # from bad and from good, to bad and to good
    states = patterns.astype(int)
    chain = np.array([turns[states, after].prod(axis=1) for after in states])  # (to, from)

    def frame(moments: Floats) -> Floats:
        mixed = np.tensordot(chain, moments.reshape(count, n, n), axes=1)
        return np.asarray(each @ mixed @ each.transpose(0, 2, 1)).ravel()

    operator = LinearOperator((count * n * n,) * 2, matvec=frame)
    start = np.tile(np.eye(n).ravel(), count)
    return float(np.abs(eigs(operator, k=4, ncv=KRYLOV, which="LM", v0=start, tol=1e-12)[0]).max())


def course_by_hand(peers: int, stiffness: float, loss: float) -> tuple[float, float]:
    """Return the exponent a frame of motions over lost packets, and half its interval of 95 %, by playing."""
    each, patterns = matrices(peers, stiffness)
    chances = np.where(patterns, 1 - loss, loss).prod(axis=1)
    random = np.random.default_rng(16)
    moved = random.standard_normal((COURSES_BY_HAND, each.shape[1], 1))
    grown = np.zeros(COURSES_BY_HAND)
    for step in range(SETTLING + COURSE):
        moved = each[random.choice(len(each), COURSES_BY_HAND, p=chances)] @ moved
        size = np.linalg.norm(moved, axis=(1, 2))
        grown += np.log(size) * (step >= SETTLING)
        moved /= size[:, None, None]
    found = grown / COURSE
    return float(found.mean()), float(1.96 * found.std(ddof=1) / math.sqrt(COURSES_BY_HAND))


def judged(text: str, runs: int) -> tuple[float, Growth]:
    """Return the seconds of a verdict over the network of a scene that is prepared, and the verdict."""
    system = system_of(text)
    call: Callable[[], Growth] = partial(growth, system, prepare(system))
    call()
    return median_time(call, runs)


def error_of(found: Growth) -> float:
    """Return how far a growth may be from the truth."""
    return max(found.high - found.radius, found.radius - found.low)


def independent(judge: Judge, runs: int) -> None:
    """Print verdicts of packets lost one by one."""
    seconds, found = judged(scene(PEERS, STIFFNESS, loss=f"{LOSS:.0%}"), runs)
    hand, own = timed(partial(by_hand, PEERS, STIFFNESS, LOSS))
    print(f"packets lost one by one, {LOSS:.0%}: growth of mean squares a frame")
    row("3 users", seconds, found, own, max(EXACT, error_of(found)), judge)
    print(f"  by hand           {1e3 * hand:9.1f} ms   {own:.13f}   {hand / seconds:.0f} times as long")
    target("3 users", seconds, INDEPENDENT_S, judge)
    many, crowd = judged(scene(MANY, STIFFNESS, loss=f"{LOSS:.0%}"), runs)
    mesh = scene(MANY, STIFFNESS / (MANY - 1), loss=f"{LOSS:.0%}", coupler="FullMesh")
    _, summed = judged(mesh, 1)
    row("a million", many, crowd, summed.radius, error_of(crowd) + error_of(summed), judge, "its mesh")
    ratio = many / seconds
    print(f"    of three        {ratio:9.2f}      {judge.in_time('a million users', ratio, MILLION)}")


def row(
    what: str,
    seconds: float,
    found: Growth,
    truth: float,
    bound: float,
    judge: Judge,
    beside: str = "by hand",
) -> None:
    """Print a verdict, its time, its error and its bound."""
    off = abs(found.radius - truth)
    print(
        f"  {what:<16} {1e3 * seconds:10.1f} ms   {found.radius:.13f} ± {error_of(found):.0e}   "
        f"off {beside} by {off:.0e} {judge.within(what, off, bound)}"
    )


def target(what: str, seconds: float, most: float, judge: Judge) -> None:
    """Print whether a time is within its target."""
    print(f"  target           {1e3 * most:10.1f} ms   {judge.in_time(what, seconds, most)}")


def curve(judge: Judge) -> None:
    """Print how long the largest stiffness over all losses takes, and how far it is from what is by hand."""
    system = system_of(scene(PEERS, 500.0, loss=f"{LOSS:.0%}"))
    seconds, found = timed(lambda: region(system, parse_axes(system, *CURVE)))
    points = sum(len(one.points) for one in found.curves)
    print("\nlargest stiffness of 3 users, 0 to 60 % lost")
    kept = judge.in_time("a curve", seconds, CURVE_S)
    print(
        f"  {points} points, error ≤ {found.curves[0].error:.0e}  {seconds:.2f} s  target {CURVE_S} s {kept}"
    )
    off = off_by_hand(found)
    print(f"  growth there by hand is 1 within {off:.0e} {judge.within('a curve', off, ITERATED)}")


def off_by_hand(found: Region) -> float:
    """Return how far from 1 second moments grow at points of a curve."""
    points = found.curves[0].points
    chosen = points[np.linspace(0, len(points) - 1, LOOKED).astype(int)]
    return max(abs(by_hand(PEERS, float(y), float(x)) - 1) for x, y in chosen)


def bursts(judge: Judge) -> None:
    """Print verdicts over bursts."""
    p, r = BURSTS
    words = f"{{p: {p}, r: {r}}}"
    print(f"\nbursts of {1 / r:.0f} packets, {p / (p + r):.0%} lost in all")
    for peers in (2, PEERS):
        seconds, found = judged(scene(peers, STIFFNESS, loss=words), 3)
        hand, own = timed(partial(bursts_by_hand, peers, STIFFNESS, p, r))
        row(f"{peers} users", seconds, found, own, ITERATED, judge)
        print(f"  by hand           {1e3 * hand:9.1f} ms   {own:.13f}   {hand / seconds:.1f} times as long")
    target("bursts, 3 users", seconds, BURSTS_S, judge)
    seconds, found = judged(scene(TAGGED, STIFFNESS, loss=words), 1)
    print(
        f"  {TAGGED} users          {1e3 * seconds:10.1f} ms   {found.radius:.9f}, orders 2 and 3 differ by "
        f"{error_of(found):.0e}"
    )
    judge.right("an estimate is called one", not found.exact and bool(found.note))
    target("bursts, 5 users", seconds, TAGGED_S, judge)


def boxes(judge: Judge, points: int) -> None:
    """Print boxes of a stiffness and the share lost, and what grows at points of them by hand."""
    print(f"\nboxes about {FEW_STIFFNESS:g} N/m and {LOSS:.0%} lost, 2 users")
    system = system_of(scene(2, FEW_STIFFNESS, loss=f"{LOSS:.0%}"))
    random = np.random.default_rng(15)
    for wide in WIDTHS:
        low, high = FEW_STIFFNESS * (1 - wide), FEW_STIFFNESS * (1 + wide)
        ranges = {
            "coordination.stiffness": f"±{wide:.0%}",
            "lan.loss": f"{LOSS * (1 - wide)}:{LOSS * (1 + wide)}",
        }
        seconds, found = median_time(partial(prove_box, system, ranges), 3)
        drawn = random.uniform((low, LOSS * (1 - wide)), (high, LOSS * (1 + wide)), (points, 2))
        hand, grown = timed(lambda drawn=drawn: max(by_hand(2, *one) for one in drawn.tolist()))
        holds = judge.right(f"a box of {wide:.0%}", found.stable is not True or grown < 1)
        print(
            f"  ±{wide:<4.0%} {found.cells:5} cells {1e3 * seconds:9.1f} ms   {found.open_share:6.1%} open   "
            f"at {points} points by hand {1e3 * hand / points:.1f} ms each, at most {grown:.4f} {holds}"
        )


def luck(judge: Judge) -> None:
    """Print the exponent of almost every course of luck, beside courses played by hand."""
    system = system_of(scene(PEERS, STIFFNESS, loss=f"{LOSS:.0%}"))
    seconds, found = timed(lambda: almost_sure(system, prepare(system)))
    assert found is not None
    low, high = found.interval
    taken, (own, half) = timed(partial(course_by_hand, PEERS, STIFFNESS, LOSS))
    apart = abs(own - found.exponent) / math.hypot(half, (high - low) / 2)
    print("\nalmost surely, 3 users: exponent a frame")
    print(
        f"  {COURSES * FRAMES:,} frames    {seconds:6.2f} s   {found.exponent:.7f} ({low:.7f} to {high:.7f})"
    )
    print(
        f"  by hand {COURSES_BY_HAND * COURSE:,}     {taken:6.2f} s   {own:.7f} ± {half:.7f}   "
        f"apart by {apart:.1f} half widths {judge.within('almost surely', apart, FAR)}"
    )


def coverage(judge: Judge, estimates: int) -> None:
    """Judge how many intervals of 95 % hold the mean of all estimates, each of a million frames."""
    system = system_of(scene(PEERS, STIFFNESS, loss=f"{LOSS:.0%}"))
    prepared = prepare(system)
    found = [almost_sure(system, prepared, seed=seed) for seed in range(1, estimates + 1)]
    known = [one for one in found if one is not None]
    mean = float(np.mean([one.exponent for one in known]))
    held = sum(low <= mean <= high for low, high in (one.interval for one in known))
    told = f"{held} of {estimates} intervals of 95 % hold the mean of all"
    print(f"\n{told}, of {COURSES * FRAMES:,} frames each")
    judge.right(told, held >= LEAST_HELD * estimates)


def main() -> None:
    """Print all of it."""
    parser = parser_of("network", __doc__)
    parser.add_argument("--quick", action="store_true", help="fewer runs")
    given = parser.parse_args()
    judge = Judge(given.strict)
    with single_threaded(), np.errstate(all="ignore"):
        independent(judge, 5 if given.quick else 15)
        curve(judge)
        bursts(judge)
        boxes(judge, 5 if given.quick else 20)
        luck(judge)
        coverage(judge, 20 if given.quick else 100)
    judge.end()


if __name__ == "__main__":
    main()
