"""Verdicts over networks that lose packets, error beside time: `python -m tests.bench.network`.

The opponent is written by hand: the paper's users and what each hears of each in one matrix a pattern of
losses (`tests.held_scenes`), second moments moved by all of them, A ⊗ A times the pattern's chance, the
largest eigenvalue by LAPACK; under bursts one such matrix a state of all channels, by ARPACK. Times are CPU
seconds, of a compiled and once analysed scene: what is added to the nominal answer.
"""

from __future__ import annotations

import itertools
from functools import partial

import numpy as np
from scipy.linalg import matrix_balance, null_space
from scipy.sparse.linalg import LinearOperator, eigs

import apc
from apc.analysis.analysis import prepare
from apc.benchmark.timing import median_time, timed
from apc.moments.network import Growth, growth
from tests.bench.by_hand import Floats
from tests.bench.judge import Judge, Timed, judged, parser_of
from tests.held_scenes import frames, scene, system_of

STIFFNESS, LOSS = 1100.0, 0.1
BURSTS = 0.02, 0.1  # from good to bad, and back: bursts of ten packets, a sixth of all
PEERS, MANY, TAGGED = 3, 10**6, 5
# Seconds: of what is independent, of a curve, of bursts by all moments, and by those of orders 2 and 3. A
# million users may take so many times what three do.
INDEPENDENT_S, CURVE_S, BURSTS_S, TAGGED_S, MILLION = 0.005, 1.0, 2.0, 30.0, 1.5
# What eigenvalues of hundreds of rows by LAPACK are right to, and those of thousands by ARPACK or, where most
# packets are lost, by LAPACK; vectors it keeps.
EXACT, ITERATED, KRYLOV = 1e-8, 1e-7, 60
CURVE = {"x": "lan.loss=0:0.6", "y": "coordination.stiffness=1000 N/m:2000 N/m"}
LOOKED = 5  # points of a curve that are asked of the opponent


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
    hand, truth = timed(partial(by_hand, PEERS, STIFFNESS, LOSS))
    off, bound = abs(verdict.radius - truth), max(EXACT, error_of(verdict))
    many, crowd = decided(scene(MANY, STIFFNESS, loss=f"{LOSS:.0%}"), runs)
    _, mesh = decided(scene(MANY, STIFFNESS / (MANY - 1), loss=f"{LOSS:.0%}", coupler="FullMesh"), 1)
    apart, open_ = abs(crowd.radius - mesh.radius), error_of(crowd) + error_of(mesh)
    title = f"growth of mean squares a frame, {PEERS} users, {LOSS:.0%} lost one by one"
    rows = [Timed("apc", seconds, off, bound), Timed("every pattern of losses, LAPACK", hand)]
    rows.append(Timed("apc, a million users", many, apart, open_))
    judge.table(title, rows, most_s=INDEPENDENT_S)
    print("  a million users:", judge.in_time("a million users beside three", many / seconds, MILLION))


def curve(judge: Judge) -> None:
    """Print how long the largest stiffness over all losses takes, and how far it is from what is by hand."""
    system = system_of(scene(PEERS, 500.0, loss=f"{LOSS:.0%}"))
    seconds, found = timed(partial(apc.region, system, **CURVE))
    points = found.curves[0].points
    chosen = points[np.linspace(0, len(points) - 1, LOOKED).astype(int)].tolist()
    off = max(abs(by_hand(PEERS, y, x) - 1) for x, y in chosen)
    title = f"largest stiffness of {PEERS} users, 0 to 60 % lost: growth there by hand is 1"
    judge.table(title, [Timed("apc", seconds, off, ITERATED)], most_s=CURVE_S)


def bursts(judge: Judge, quick: bool) -> None:
    """Print verdicts over bursts."""
    p, r = BURSTS
    words = f"{{p: {p}, r: {r}}}"
    title = f"bursts of {1 / r:.0f} packets, {p / (p + r):.0%} lost in all, {{}} users"
    for peers in (2, PEERS):
        seconds, verdict = decided(scene(peers, STIFFNESS, loss=words), 3)
        hand, truth = timed(partial(bursts_by_hand, peers, STIFFNESS, p, r))
        ours = Timed("apc", seconds, abs(verdict.radius - truth), ITERATED)
        theirs = Timed("every state of the channels, ARPACK", hand)
        judge.table(title.format(peers), [ours, theirs], most_s=BURSTS_S)
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
