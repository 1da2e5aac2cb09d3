"""Verdicts over networks that lose packets, error beside time: `python -m tests.bench.network`.

The opponent follows second moments event by event and draw by draw, by ARPACK
(`tests.networks.second_moments`). Times are CPU seconds, of a compiled and once analysed
scene: what is added to the nominal answer.
"""

from __future__ import annotations

from functools import partial

import numpy as np

import apc
from apc.analysis.analysis import prepare
from apc.benchmark.timing import median_time, timed
from apc.moments.network import Growth, growth
from tests.bench.judge import Judge, Timed, judged, parser_of
from tests.held_scenes import scene, system_of
from tests.networks.second_moments import Law, second_moment_radius

STIFFNESS, LOSS = 1100.0, 0.1
P, R = 0.02, 0.1  # from good to bad, and back: bursts of ten packets, a sixth of all
PEERS, MANY, TAGGED = 3, 10**6, 5
# Seconds: of what is independent, of a curve, of bursts by all moments, and by those of orders 2 and 3. A
# million users may take so many times what three do.
INDEPENDENT_S, CURVE_S, BURSTS_S, TAGGED_S, MILLION = 0.005, 1.0, 2.0, 30.0, 1.5
ITERATED = 1e-7  # what eigenvalues of thousands of rows by ARPACK are right to at least
CURVE = {"x": "lan.loss=0:0.6", "y": "coordination.stiffness=1000 N/m:2000 N/m"}
LOOKED = 5  # points of a curve that are asked of the opponent
OTHER = "event by event, ARPACK"


def by_hand(peers: int, stiffness: float, law: Law) -> float:
    """Return the growth of second moments a frame, by the opponent."""
    return second_moment_radius(system_of(scene(peers, stiffness, loss="10%")), {"lan": law})


def decided(text: str, runs: int) -> tuple[float, Growth]:
    """Return the seconds of a verdict over the network of a scene that is prepared, and the verdict."""
    system = system_of(text)
    call = partial(growth, system, prepare(system))
    call()
    return median_time(call, runs)


def error_of(verdict: Growth) -> float:
    """Return how far a growth may be from the truth."""
    return max(verdict.high - verdict.radius, verdict.radius - verdict.low)


def independent(judge: Judge, runs: int) -> None:
    """Print verdicts of packets lost one by one, of three users and of a million."""
    seconds, verdict = decided(scene(PEERS, STIFFNESS, loss=f"{LOSS:.0%}"), runs)
    hand, truth = timed(partial(by_hand, PEERS, STIFFNESS, Law(LOSS, 1 - LOSS)))
    many, crowd = decided(scene(MANY, STIFFNESS, loss=f"{LOSS:.0%}"), runs)
    _, mesh = decided(scene(MANY, STIFFNESS / (MANY - 1), loss=f"{LOSS:.0%}", coupler="FullMesh"), 1)
    title = f"growth of mean squares a frame, {PEERS} users, {LOSS:.0%} lost one by one"
    rows = [
        Timed("apc", seconds, abs(verdict.radius - truth), max(1e-10, error_of(verdict))),
        Timed(OTHER, hand),
        Timed("apc, a million", many, abs(crowd.radius - mesh.radius), error_of(crowd) + error_of(mesh)),
    ]
    judge.table(title, rows, most_s=INDEPENDENT_S)
    print("  a million users:", judge.in_time("a million users beside three", many / seconds, MILLION))


def curve(judge: Judge) -> None:
    """Print how long the largest stiffness over all losses takes, and how far it is from what is by hand."""
    system = system_of(scene(PEERS, 500.0, loss=f"{LOSS:.0%}"))
    seconds, region = timed(partial(apc.region, system, **CURVE))
    points = region.curves[0].points
    chosen = points[np.linspace(0, len(points) - 1, LOOKED).astype(int)].tolist()
    off = max(abs(by_hand(PEERS, y, Law(x, 1 - x)) - 1) for x, y in chosen)
    title = f"largest stiffness of {PEERS} users, 0 to 60 % lost: growth there by hand is 1"
    judge.table(title, [Timed("apc", seconds, off, ITERATED)], most_s=CURVE_S)


def bursts(judge: Judge, quick: bool) -> None:
    """Print verdicts over bursts."""
    words = f"{{p: {P}, r: {R}}}"
    title = f"bursts of {1 / R:.0f} packets, {P / (P + R):.0%} lost in all, {{}} users"
    for peers in (2, PEERS)[: 1 if quick else 2]:
        seconds, verdict = decided(scene(peers, STIFFNESS, loss=words), 3)
        hand, truth = timed(partial(by_hand, peers, STIFFNESS, Law(P, R)))
        rows = [Timed("apc", seconds, abs(verdict.radius - truth), ITERATED), Timed(OTHER, hand)]
        judge.table(title.format(peers), rows, most_s=BURSTS_S)
    if not quick:
        seconds, verdict = decided(scene(TAGGED, STIFFNESS, loss=words), 1)
        judge.right("an estimate is called one", not verdict.exact and bool(verdict.note))
        remark = f"orders 2 and 3 differ by {error_of(verdict):.0e}"
        judge.table(title.format(TAGGED), [Timed("apc", seconds, None, None, remark)], most_s=TAGGED_S)


def main() -> None:
    """Print all of it."""
    with judged(parser_of("network", __doc__)) as (judge, given):
        independent(judge, 5 if given.quick else 15)
        bursts(judge, given.quick)
        if not given.quick:
            curve(judge)


if __name__ == "__main__":
    main()
