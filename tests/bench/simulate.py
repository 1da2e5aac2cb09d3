"""How right and how fast `apc simulate` is: `python -m tests.bench.simulate`.

A time is the median of a few runs in a warm process, after compiling; beside it stand programs written by hand
for this one scene, in NumPy and C (`tests.bench.by_hand`), or time itself.
"""

from __future__ import annotations

import math
from fractions import Fraction
from functools import partial

import numpy as np

from apc.benchmark.timing import median_time, waited
from apc.network.channel import PacketSource, channel_law
from apc.simulation.ensemble import play_many
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from apc.simulation.trajectory import simulate
from tests.bench.by_hand import CUBE_MASS, START, TICKS, USERS, Floats, c_loop, numpy_loop, numpy_runs
from tests.bench.comparison import MOVED, rows_of
from tests.bench.judge import Judge, Timed, judged, parser_of
from tests.lossy import APART, LINK, STARTS
from tests.topologies import AVERAGE, compiled, replaced

REPEATS = 7
# Relative, of 10 s: 10,000 ticks each round by 1e-16, which all in one direction are 1e-12.
LINEAR = 1e-12
# Of real time, for 300 peers on unreliable links, and how their time grows, which is as their ways do but for
# what no longer fits the caches.
MOST_LOSSY, MOST_EXPONENT = 1.0, 2.2
RUNS, FEW, LOSS, SEED = 1000, 20, 0.05, 3
STATES = ("device.x", "device.v", "cube.x", "cube.v")


def speed(judge: Judge) -> None:
    """10 s of the three-user scene, every signal recorded, beside the loops in NumPy and in C."""
    system = compiled(MOVED)
    first, run = waited(partial(simulate, system, duration=Fraction(10)))  # a C compiler's time included
    loop, by_hand = median_time(partial(numpy_loop, 10_001), 3)
    in_c, end = median_time(partial(c_loop, USERS, 1250, 1), REPEATS)
    kept = [place for place, one in enumerate(run.signals) if not one.local.endswith(" acting")]
    print(f"10 s of three users, {len(run.signals)} signals, the first time {first:.2f} s")

    def off(values: Floats) -> float:
        apart = np.abs(values[:, kept].reshape(-1, USERS, 6) - by_hand).max(axis=(0, 1))
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
        taken, rows = median_time(partial(rows_of, prepare(system, Settings(Fraction(10), jit=jit))), REPEATS)
        ours = Timed("apc", taken, off(rows), LINEAR)
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
    taken, rows = median_time(partial(rows_of, ready), REPEATS)
    columns = [[one.local for one in ready.signals].index(name) for name in STATES]
    error = float((np.abs(rows[-1, columns] - states[:, 0]) / np.abs(states[:, 0])).max())
    programs = [
        Timed("apc", taken, error, LINEAR),
        Timed("C, a frame of a peer in registers", by_hand),
        Timed("time itself", float(seconds)),
    ]
    judge.table(f"{number:,} equal peers, {frames * TICKS} ticks", programs, most={programs[1].program: 3.0})


def lossy(judge: Judge, numbers: list[int]) -> None:
    """Peers that hear each other over ways that lose packets, each way by itself."""
    print("\npeers on a complete graph of unreliable links, 5 % lost, up to 4 ms late or early")
    times = []
    for number in numbers:
        seconds = Fraction(1) if number < 1000 else Fraction(1, 5)
        moved = ("{count: 3}", f"{{count: {number}, set: {{device.x: 1 mm}}}}")
        text = replaced(AVERAGE, moved, (LINK, f"{LINK[:-1]}, loss: 5 %, jitter: 4 ms}}"))
        ready = prepare(compiled(text), Settings(seconds, seed=SEED), signals=["user[1].*"])
        times.append(median_time(partial(rows_of, ready), 3)[0] / float(seconds))
        kept = judge.in_time("300 lossy peers", times[-1], MOST_LOSSY) if number == 300 else ""
        print(f"  {number:>7} peers   {times[-1]:8.3f} of real time   {kept}")
    exponent = math.log(times[-1] / times[0]) / math.log(numbers[-1] / numbers[0])
    print(f"  exponent {exponent:.2f}: {judge.in_time('lossy peers, exponent', exponent, MOST_EXPONENT, 1)}")


def _draw_and_play(ticks: int, starts: Floats) -> Floats:
    """Do all that the program by hand does: its own packets, the runs, when each settles."""
    lost = np.random.default_rng(SEED).random((ticks // TICKS + 1, RUNS, USERS, USERS)) < LOSS
    rows, _, _ = numpy_runs(lost, ticks, starts)
    span = np.ptp(rows, axis=0).max(axis=1, keepdims=True)
    outside = (np.abs(rows - rows[-1]) > 0.05 * span).any(axis=(2, 3))
    return np.asarray(ticks - outside[::-1].argmax(axis=0), np.float64)


def many_runs(judge: Judge) -> None:
    """Many runs of a second of three users, each with packets of its own."""
    ticks = 1001
    starts = np.array([float(word.split()[0]) * 1e-3 for word in STARTS[1:-1].split(",")])
    system = compiled(replaced(AVERAGE, APART, (LINK, f"{LINK[:-1]}, loss: 5 %}}")))
    call = partial(play_many, system, Settings(Fraction(1), seed=SEED), runs=RUNS)
    call()  # compiled
    taken, ours = median_time(call, 5)
    by_hand, _ = median_time(partial(_draw_and_play, ticks, starts), 3)
    law = channel_law(system, system.links[0], Fraction(8, 1000))
    pairs = [(i, j) for i in range(USERS) for j in range(USERS)]
    delays = [
        PacketSource(law, "lan", pairs, seed=SEED, run=run).take(ticks // TICKS + 1) for run in range(FEW)
    ]
    lost = np.isinf(np.array(delays)).reshape(FEW, USERS, USERS, -1).transpose(3, 0, 1, 2)
    theirs = np.array(numpy_runs(lost, ticks, starts)[1:])
    same = np.array([(one.largest_force, one.copies_apart) for one in ours.runs[:FEW]], np.float64).T
    error = float((np.abs(same - theirs) / theirs.max(axis=1, keepdims=True)).max())
    programs = [Timed("apc", taken, error, LINEAR), Timed("NumPy, all runs at once", by_hand)]
    judge.table(f"{RUNS:,} runs of a lossy second", programs, most={programs[1].program: 1.5})


def main() -> None:
    """Print everything."""
    with judged(parser_of("simulate", __doc__)) as (judge, given):
        speed(judge)
        many_peers(judge, 10**4 if given.quick else 10**5)
        lossy(judge, [100, 300] if given.quick else [100, 300, 1000])
        many_runs(judge)


if __name__ == "__main__":
    main()
