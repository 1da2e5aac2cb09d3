"""How long a critical value takes, and how far from the truth it is: `python -m tests.bench.critical`.

The truth is the same crossing in 60 digits (`tests.paper_limit`), of which a mesh of three bears half. With
longer and longer delays it stands beside what a few lines by hand do without a bound: the eigenvalues of all
peers event by event (`tests.bruteforce`), over a gain by bisection, over a delay one after another.
"""

from __future__ import annotations

from fractions import Fraction
from functools import partial

import numpy as np

import apc
from apc.benchmark.timing import median_time, timed
from tests.bench.by_hand import K_C
from tests.bench.judge import Judge, Timed, judged, parser_of
from tests.bruteforce import Scene, frame_matrices
from tests.paper_limit import limit
from tests.topologies import AVERAGE, MESH, compiled

STIFFNESS = "coordination.stiffness"
# Frames that packets are late, and by hand at most; what the longest may take; how near a bisection comes.
FRAMES, BY_HAND, LONGEST_S, NEAR = (1, 10, 30, 100, 300), 30, 0.5, 1e-9
UPPER_MS, DELAY_S = (200, 2000), 2.0


def stable(scene: Scene) -> bool:
    """Return whether everything but the common translation dies out."""
    return bool(np.sort(np.abs(np.linalg.eigvals(frame_matrices(scene, 1)[0])))[-2] < 1)


def gain_by_hand(frames: int) -> float:
    """Return the least critical stiffness with packets so many frames late: steps of 10 %, then halvings."""

    def scene(k_t: float) -> Scene:
        return Scene(kc=K_C, kt=k_t, comm=Fraction(frames, 125))

    high = 10.0
    while stable(scene(high)):
        high *= 1.1
    low = high / 1.1
    while high - low > NEAR * high:
        middle = (low + high) / 2
        low, high = (middle, high) if stable(scene(middle)) else (low, middle)
    return low


def delay_by_hand(upper_ms: int) -> float | None:
    """Return the first delay, in seconds, from which on the scene is unstable."""
    late = (one for one in range(upper_ms) if not stable(Scene(kc=K_C, comm=Fraction(2 * one + 1, 2000))))
    first = next(late, None)
    return None if first is None else first / 1000


def schemes(judge: Judge, repeat: int) -> None:
    """Print what the critical value of each scheme takes."""
    known = float(limit(K_C, 1096.0))
    for name, text, exact in (("AP", AVERAGE, known), ("VC", MESH, known / 2)):
        call = partial(apc.critical, compiled(text), STIFFNESS)
        first, found = timed(call)
        assert found.value is not None
        assert found.error is not None
        off = abs(found.value / exact - 1)
        rows = [Timed("apc", median_time(call, repeat)[0], off, max(found.error / exact, 2e-16))]
        judge.table(f"critical {STIFFNESS} of {name}", [*rows, Timed("apc, the first time", first)])


def delays(judge: Judge, quick: bool) -> None:
    """Print what critical values take with long delays, beside what is done by hand."""
    for frames in FRAMES[: 2 if quick else None]:
        late = {"lan.delay": f"{8 * frames} ms"}
        seconds, found = timed(lambda late=late: apc.critical(compiled(AVERAGE), STIFFNESS, set=late))
        assert found.value is not None
        rows = [Timed("apc", seconds, None, None, f"≤ {(found.error or 0) / found.value:.0e}")]
        if frames <= BY_HAND:
            taken, value = timed(partial(gain_by_hand, frames))
            off = abs(value / found.value - 1)
            rows.append(Timed("bisection, all eigenvalues", taken, off, 2 * NEAR))
        judge.table(f"critical {STIFFNESS}, {frames} frames late", rows, most_s=LONGEST_S)
    for upper in UPPER_MS[: 1 if quick else None]:
        call = partial(apc.critical, compiled(AVERAGE), "lan.delay", upper=f"{upper} ms")
        seconds, found = timed(call)
        taken, first = timed(partial(delay_by_hand, upper))
        title = f"critical lan.delay up to {upper} ms"
        judge.right(f"{title}, by hand", first == found.value)
        rows = [Timed("apc", seconds, None, None, f"≤ {found.error or 0:.0e} s")]
        rows.append(Timed("eigenvalues at each delay", taken, None, None, "same delay"))
        judge.table(title, rows, most_s=DELAY_S)


def main() -> None:
    """Print the tables."""
    with judged(parser_of("critical", __doc__)) as (judge, given):
        schemes(judge, 3 if given.quick else 20)
        delays(judge, given.quick)


if __name__ == "__main__":
    main()
