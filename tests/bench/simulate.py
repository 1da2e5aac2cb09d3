"""How right and how fast `apc simulate` is: `python -m tests.bench.simulate`.

A time is the median of a few runs in a warm process, after compiling; beside it stand programs written by
hand for this one topology, in NumPy and C (`tests.bench.by_hand`), or time itself.
"""

from __future__ import annotations

import time
from fractions import Fraction
from functools import partial

import numpy as np

from apc.benchmark.timing import median_time
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from apc.simulation.trajectory import simulate
from tests.bench.by_hand import CUBE_MASS, START, TICKS, USERS, Floats, c_loop, numpy_loop
from tests.bench.comparison import MOVED, rows_of
from tests.bench.judge import Judge, Timed, decided, parser_of
from tests.topologies import AVERAGE, compiled, replaced

REPEATS = 7
# Relative, of 10 s: 10,000 ticks each round by 1e-16, which all in one direction are 1e-12.
LINEAR = 1e-12
STATES = ("device.x", "device.v", "cube.x", "cube.v")


def speed(judge: Judge) -> None:
    """10 s of the three-user topology, every signal recorded, beside the loops in NumPy and in C."""
    model = compiled(MOVED)
    began = time.perf_counter()  # the C compiler's time included
    run = simulate(model, duration=Fraction(10))
    first = time.perf_counter() - began
    loop, by_hand = median_time(partial(numpy_loop, 10_001), 3)
    in_c, end = median_time(partial(c_loop, USERS, 1250, 1), REPEATS)
    stored = [place for place, one in enumerate(run.signals) if not one.local.endswith(" acting")]
    print(f"10 s of three users, {len(run.signals)} signals, the first time {first:.2f} s")

    def off(values: Floats) -> float:
        apart = np.abs(values[:, stored].reshape(-1, USERS, 6) - by_hand).max(axis=(0, 1))
        return float((apart / np.abs(by_hand).max(axis=(0, 1))).max())

    size = np.abs(by_hand[:, :, :4]).max(axis=(0, 1))
    others = [
        Timed("NumPy, a loop over ticks", loop),
        Timed(
            "C, the last states only",
            in_c,
            float((np.abs(end.T - by_hand[10_000, :, :4]) / size).max()),
            LINEAR,
        ),
    ]
    for name, jit, part, most_s in (("virtual machine", False, 0.8, None), ("machine code", True, 0.2, 0.01)):
        used, rows = median_time(partial(rows_of, prepare(model, Settings(Fraction(10), jit=jit))), REPEATS)
        ours = Timed("apc", used, off(rows), LINEAR)
        most = {others[0].program: part}
        judge.table(f"10 s of three users, {name}", [ours, *others], most_s=most_s, most=most)


def many_peers(judge: Judge, number: int) -> None:
    """Equal peers beside a C loop by hand, compiled alike."""
    frames = 25
    seconds = Fraction(frames * TICKS, 1000)
    count = ("{count: 3}", f"{{count: {number}, set: {{device.x: {START} m}}}}")
    text = replaced(AVERAGE, count, ("0.6 kg", f"{CUBE_MASS!r} kg"), (", shared: true", ""))
    ready = prepare(compiled(text), Settings(seconds), signals=["user[1].*"])
    c_loop(number, 1, number)  # compiled
    by_hand, states = median_time(partial(c_loop, number, frames, number), REPEATS)
    used, rows = median_time(partial(rows_of, ready), REPEATS)
    columns = [[one.local for one in ready.signals].index(name) for name in STATES]
    error = float((np.abs(rows[-1, columns] - states[:, 0]) / np.abs(states[:, 0])).max())
    programs = [
        Timed("apc", used, error, LINEAR),
        Timed("C, a frame of a peer in registers", by_hand),
        Timed("time itself", float(seconds)),
    ]
    judge.table(f"{number:,} equal peers, {frames * TICKS} ticks", programs, most={programs[1].program: 3.0})


def main() -> None:
    """Print everything."""
    with decided(parser_of("simulate", __doc__)) as (judge, given):
        speed(judge)
        many_peers(judge, 10**4 if given.quick else 10**5)


if __name__ == "__main__":
    main()
