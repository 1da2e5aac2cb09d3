# ruff: noqa: E501 -- tables are printed by long lines
"""How right and how fast `apc simulate` is: `python -m tests.bench.simulate`.

Errors stand beside times. A time is the median of a few runs in a warm process, after compiling; a ratio compares with a
program written by hand for this one scene, in NumPy or C, with time itself, or with smaller populations.
"""

from __future__ import annotations

import ctypes
import functools
import math
import resource
from collections.abc import Callable
from fractions import Fraction
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import cast

import casadi
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from apc.analysis.analysis import analyze, lifted_groups
from apc.benchmark.timing import median_time, waited
from apc.eigen.modes import dense
from apc.network.channel import PacketSource, channel_law
from apc.simulation.blocks import Block, blocks
from apc.simulation.ensemble import play_many
from apc.simulation.native import native
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare
from apc.simulation.trajectory import simulate
from apc.threads import single_threaded
from tests.bench.judge import Judge, parser_of
from tests.bench.paper_scene import (
    CUBE_DAMPING,
    CUBE_MASS,
    DEVICE_DAMPING,
    FRAME,
    K_C,
    K_T,
    START,
    TICK,
    TICKS,
    USERS,
    Floats,
    user_plant,
)
from tests.eventwise import experiment, play
from tests.lossy import APART, LINK, STARTS
from tests.topologies import AVERAGE, MESH, SCENES, compiled, replaced

MOVED = replaced(AVERAGE, ("{count: 3}", f"{{count: 3, set: {{device.x: [{START} m, 0 m, 0 m]}}}}"))
REPEATS = 7

# Relative, of 10 s: 10,000 ticks each round by 1e-16, which all in one direction are 1e-12.
LINEAR = 1e-12
# In m, m/s and N, of 3 s: a contact that closes a tick late is 1e-4 m off, roundings are below this.
CONTACTS = 1e-9
# Relative: the largest motion turns by 1.04 rad a frame, so that of the last half turn of a stretch, 3 frames,
# one has cos(0.52) of the whole swing: the largest value is 0.87/1.024³ = 0.81 to 1 of what grows evenly, and
# the thousandth root of a ratio of two such is 2.1e-4 off.
GROWTH = 2.1e-4
# Relative: a delay off by a tick would be 9 %; the formula takes the speed as even within a frame.
DRAG = 1e-3
# Times: ms, and a part of the NumPy loop's; CasADi's virtual machine moves three peers little faster than NumPy.
MOST_MS, MOST_PART, MOST_PART_VIRTUAL = 10.0, 0.2, 0.8
# Of the C loop by hand over equal peers, which does not add up the work of each coupler; of real time, for 300 peers on
# unreliable links, and how their time grows, which is as their ways do but for what no longer fits the caches; of the
# NumPy program of many runs.
MOST_OF_C, MOST_LOSSY, MOST_EXPONENT, MOST_OF_RUNS = 3.0, 1.0, 2.2, 1.5
RUNS, LOSS, SEED = 1000, 0.05, 3


def against_frame_map(judge: Judge) -> None:
    """10 s of the linear scene against powers of the analysis' map of all peers."""
    system = compiled(MOVED)
    closed = dense(*lifted_groups(system))
    state = np.zeros(len(closed.names))
    state[closed.motion[0]] = START
    rows = [state]
    for _ in range(1250):
        rows.append(closed.matrix @ rows[-1])
    expected = np.array(rows)[:, list(closed.motion)]
    found = simulate(system, duration=Fraction(10), signals=["device.*", "cube.*"]).values[::8]
    error = np.abs(found - expected).max() / np.abs(expected).max()
    print(
        f"10 s against powers of the frame map      relative {error:.1e}   {judge.within('powers of the frame map', error, LINEAR)}"
    )


def against_events(judge: Judge) -> None:
    """The experiment's scenes against stepping them by hand."""
    for name, operator in (("average", "mean"), ("mesh", "sum")):
        text = (SCENES / f"experiment-{name}.yaml").read_text(encoding="utf-8")
        found = simulate(compiled(text))
        expected = np.array(play(experiment(operator), Fraction(3)))[:, 1:].reshape(-1, 3, 6)
        expected[:, 0, 4] *= -1
        apart = np.abs(found.values.reshape(-1, 3, 6) - expected)
        same = bool(((found.values.reshape(-1, 3, 6)[:, :, 4] > 0) == (expected[:, :, 4] > 0)).all())
        said = judge.within(f"experiment-{name} event by event", float(apart.max()), CONTACTS)
        judge.right(f"experiment-{name}: contact states", same)
        states = "contact states agree throughout" if same else "contact states differ at some tick"
        print(
            f"experiment-{name:<8} event by event by hand   {apart[:, :, :4].max():.1e} m, m/s, "
            f"{apart[:, :, 4:].max():.1e} N   {said}   {states}: {found.summary.verdict}"
        )


def growth(judge: Judge) -> None:
    """The growth of an unstable run against the spectral radius."""
    system = compiled(replaced(MOVED, ("stiffness: 500 N/m", "stiffness: 1400 N/m")))
    found = simulate(system, duration=Fraction(16), signals=["cube.v"])
    size = np.linalg.norm(found.values[::8], axis=1)
    grown = (size[-100:].max() / size[-1100:-1000].max()) ** 1e-3
    radius = analyze(system, method="dense").spectral_radius
    off = abs(grown / radius - 1)
    said = judge.within("growth of an unstable run", off, GROWTH)
    print(
        f"growth of an unstable run a frame         {grown:.6f}, spectral radius {radius:.6f}, relative {off:.1e}   {said}"
    )


def drag(judge: Judge) -> None:
    """The drag of a moved cube against the viscosity formula."""
    # K_eff ((T_n − T_c)/2 + T_d): held on average half a frame but a tick, and a frame late.
    late = (FRAME - TICK) / 2 + FRAME
    for text, name, gain in ((AVERAGE, "average", 200.0), (MESH, "mesh", 200.0 * (USERS - 1))):
        added = gain * late
        hand = "hands: {hand: {type: ConstantForce, flange: device, force: 1 N}}\nstudies:"
        text = replaced(text, ("stiffness: 500 N/m", "stiffness: 200 N/m"), ("studies:", hand))
        found = simulate(compiled(text), duration=Fraction(4), signals=["cube.x"])
        speed = (found.values[-1, 0] - found.values[-81, 0]) / 0.080
        got = 1 / speed - DEVICE_DAMPING - CUBE_DAMPING
        off = abs(got / added - 1)
        said = judge.within(f"drag, {name}", off, DRAG)
        print(
            f"drag of a moved cube, {name:<8}            {got:.6f} N·s/m, formula {added:g}, relative {off:.1e}   {said}"
        )


def numpy_loop(ticks: int) -> Floats:
    """Play the three-user scene in NumPy, all users at once, a tick at a time; return (ticks, 3, 6)."""
    a, b = user_plant()
    both = expm(np.block([[a, b], [np.zeros((2, 6))]]) * TICK)
    e, f = both[:4, :4].T, both[:4, 4:].T
    x = np.zeros((USERS, 4))
    x[0, 0] = START
    force, acting = np.zeros((USERS, 2)), np.zeros((USERS, 2))
    sent, heard = np.zeros(USERS), np.zeros(USERS)
    rows = np.empty((ticks, USERS, 6))
    for k in range(ticks):
        rows[k, :, :4] = x
        rows[k, :, 4:] = force
        if k % TICKS == 0:
            heard, sent = sent, x[:, 2].copy()
        acting = force
        others = (heard.sum() - heard) / (USERS - 1)
        force = np.stack([K_C * (x[:, 0] - x[:, 2]), K_T * (x[:, 2] - others)], axis=1)
        x = x @ e + acting @ f
    return rows


def numba_loop() -> Callable[[int], Floats] | None:
    """Return the same loop over single numbers, compiled by numba; None where there is no numba."""
    if find_spec("numba") is None:
        return None
    njit = import_module("numba").njit
    a, b = user_plant()
    both = expm(np.block([[a, b], [np.zeros((2, 6))]]) * TICK)[:4]

    def loop(ticks: int) -> Floats:
        x, next_x = np.zeros((USERS, 4)), np.zeros((USERS, 4))
        x[0, 0] = START
        force = np.zeros((USERS, 2))
        sent, heard = np.zeros(USERS), np.zeros(USERS)
        rows = np.empty((ticks, USERS, 6))
        for k in range(ticks):
            if k % TICKS == 0:
                for i in range(USERS):
                    heard[i], sent[i] = sent[i], x[i, 2]
            total = heard.sum()
            for i in range(USERS):
                for s in range(4):
                    rows[k, i, s] = x[i, s]
                    moved = both[s, 4] * force[i, 0] + both[s, 5] * force[i, 1]
                    for q in range(4):
                        moved += both[s, q] * x[i, q]
                    next_x[i, s] = moved
                rows[k, i, 4], rows[k, i, 5] = force[i, 0], force[i, 1]
                force[i, 0] = K_C * (x[i, 0] - x[i, 2])
                force[i, 1] = K_T * (x[i, 2] - (total - heard[i]) / (USERS - 1))
            x, next_x = next_x, x
        return rows

    return cast(Callable[[int], Floats], njit(loop))


def mapaccum_loop(ticks: int) -> Floats:
    """Play it by CasADi's mapaccum: a frame of ticks is one function, whose end is the next one's start."""
    frames = -(-ticks // TICKS)
    start = np.zeros(7 * USERS)
    start[0] = START
    _, rows = _frames(frames)(start, casadi.DM(0, frames))
    return np.array(rows).T.reshape(frames * TICKS, USERS, 6)[:ticks]


@functools.cache
def _frames(number: int) -> casadi.Function:
    """Return so many frames of all users: what they are at the start, nothing → ends of frames, rows of ticks."""
    a, b = user_plant()
    both = casadi.DM(expm(np.block([[a, b], [np.zeros((2, 6))]]) * TICK)[:4])
    z, nothing = casadi.SX.sym("z", 7 * USERS), casadi.SX.sym("nothing", 0)
    x = casadi.reshape(z[: 4 * USERS], 4, USERS)
    force = casadi.reshape(z[4 * USERS : 6 * USERS], 2, USERS)
    heard, sent, rows = z[6 * USERS :].T, x[2, :], []
    for _ in range(TICKS):
        rows.append(casadi.vec(casadi.vertcat(x, force)))
        others = (casadi.sum2(heard) - heard) / (USERS - 1)
        acting = casadi.vertcat(K_C * (x[0, :] - x[2, :]), K_T * (x[2, :] - others))
        x, force = both @ casadi.vertcat(x, force), acting
    end = casadi.vertcat(casadi.vec(x), casadi.vec(force), sent.T)
    return casadi.Function("frame", [z, nothing], [end, casadi.vertcat(*rows)]).mapaccum(number)


def _play(ready: Simulation) -> list[Block]:
    return list(blocks(ready))


def speed(judge: Judge) -> None:
    """10 s of the three-user scene, every signal recorded."""
    system = compiled(MOVED)
    first, found = waited(partial(simulate, system, duration=Fraction(10)))  # a C compiler's time included
    loop, by_hand = median_time(partial(numpy_loop, 10_001), 3)
    kept = [i for i, one in enumerate(found.signals) if not one.local.endswith(" acting")]

    def off(values: Floats) -> float:
        apart = np.abs(values[:, kept].reshape(-1, 3, 6) - by_hand).max(axis=(0, 1))
        return float((apart / np.abs(by_hand).max(axis=(0, 1))).max())

    error = off(found.values)
    said = judge.within("against the NumPy loop", error, LINEAR)
    print(
        f"\n10 s of three users, 10,000 ticks, {len(found.signals)} signals (with preparing, not compiled before or found again: {first:.2f} s)"
    )
    print(f"  NumPy loop         {1e3 * loop:8.2f} ms   differs by {error:.1e}, relative   {said}")
    others = [("NumPy, a loop over ticks", loop)]
    for name, play_by_hand in (("CasADi, mapaccum", mapaccum_loop), ("numba, loops by hand", numba_loop())):
        if play_by_hand is not None:
            play_by_hand(10_001)  # compiled
            taken, rows = median_time(partial(play_by_hand, 10_001), REPEATS)
            apart = np.abs(rows - by_hand).max() / np.abs(by_hand).max()
            judge.within(f"{name} against the NumPy loop", float(apart), LINEAR)
            others.append((name, taken))
            print(f"  {name:<22} {1e3 * taken:4.2f} ms   differs by {apart:.1e}, relative")
    for name, jit, most in (("virtual machine", False, MOST_PART_VIRTUAL), ("machine code", True, MOST_PART)):
        ready = prepare(system, Settings(Fraction(10), jit=jit))
        taken, played = median_time(partial(_play, ready), REPEATS)
        error = off(np.concatenate([block.values for block in played]))
        judge.within(f"{name} against the NumPy loop", error, LINEAR)
        kept_part = judge.in_time(f"{name}, part of the NumPy loop", taken / loop, most)
        kept_s = f"{MOST_MS:g} ms {judge.in_time(f'{name}, ms', 1e3 * taken, MOST_MS)}, " if jit else ""
        for other, theirs in others:
            judge.beside(f"10 s of three users, {name}", (taken, f"{error:.1e} apart"), other, (theirs, "–"))
        print(
            f"  {name:<16}   {1e3 * taken:8.2f} ms   {taken / loop:6.4f} of the NumPy loop   target {kept_s}{most:g} {kept_part}"
        )


# What an expert writes for equal peers: a frame of a peer in registers, the peers in lanes.
BY_HAND = """\
#include <stdint.h>
__attribute__((target_clones("avx2", "default")))
void play(int64_t n, int64_t frames, double *restrict x, double *restrict v, double *restrict y, double *restrict w,
          double *restrict contact, double *restrict pull, double *restrict sent, double *restrict heard) {{
  for (int64_t frame = 0; frame < frames; frame++) {{
    double lanes[8] = {{0}};
    for (int64_t i = 0; i < n; i++) heard[i] = sent[i], sent[i] = y[i];
    for (int64_t i = 0; i < n; i += 8)
      for (int64_t k = 0; k < 8 && i + k < n; k++) lanes[k] += heard[i + k];
    double total = 0;
    for (int k = 0; k < 8; k++) total += lanes[k];
    #pragma GCC ivdep
    for (int64_t i = 0; i < n; i++) {{
      double a = x[i], b = v[i], c = y[i], d = w[i], f = contact[i], g = pull[i], others = (total - heard[i]) / (n - 1);
      #pragma GCC unroll {ticks}
      for (int tick = 0; tick < {ticks}; tick++) {{
        double f_now = f, g_now = g;
        f = {k_c} * (a - c);
        g = {k_t} * (c - others);
        {moves}
      }}
      x[i] = a; v[i] = b; y[i] = c; w[i] = d; contact[i] = f; pull[i] = g;
    }}
  }}
}}
"""


def c_loop(number: int, frames: int) -> Floats:
    """Play equal peers in C by hand; return their states (4, number) after so many frames."""
    a, b = user_plant()
    both = expm(np.block([[a, b], [np.zeros((2, 6))]]) * TICK)[:4]
    names = ("a", "b", "c", "d", "f_now", "g_now")
    sums = [
        " + ".join(f"{float(value)!r} * {name}" for value, name in zip(row, names, strict=True) if value)
        for row in both
    ]
    moves = f"double p = {sums[0]}, q = {sums[1]}, r = {sums[2]}, s = {sums[3]}; a = p; b = q; c = r; d = s;"
    library = native(BY_HAND.format(ticks=TICKS, k_c=K_C, k_t=K_T, moves=moves), many=True)
    assert library is not None, "there is no C compiler"
    memory = np.zeros((8, number))
    memory[0] = START
    library.play.argtypes = [ctypes.c_int64, ctypes.c_int64, *[ctypes.c_void_p] * 8]
    library.play(number, frames, *(row.ctypes.data for row in memory))
    return memory[:4]


def against_c(judge: Judge, number: int) -> None:
    """Equal peers beside a C loop by hand, compiled alike."""
    frames = 25
    seconds = Fraction(frames * TICKS, 1000)
    many = ("{count: 3}", f"{{count: {number}, set: {{device.x: {START} m}}}}")
    text = replaced(AVERAGE, many, ("0.6 kg", f"{CUBE_MASS!r} kg"), (", shared: true", ""))
    names = ["device.x", "device.v", "cube.x", "cube.v"]
    ready = prepare(compiled(text), Settings(seconds), signals=["user[1].*"])
    c_loop(number, 1)  # compiled
    by_hand, states = median_time(partial(c_loop, number, frames), REPEATS)
    taken, found = median_time(partial(_play, ready), REPEATS)
    columns = [[one.local for one in ready.signals].index(name) for name in names]
    error = float((np.abs(found[-1].values[-1, columns] - states[:, 0]) / np.abs(states[:, 0])).max())
    ticks = number * frames * TICKS
    ours = taken, f"{error:.1e} apart"
    judge.beside(
        f"{number:,} equal peers, {frames * TICKS} ticks",
        ours,
        "C, a frame of a peer in registers",
        (by_hand, "–"),
    )
    kept = judge.in_time("equal peers, of the C loop by hand", taken / by_hand, MOST_OF_C)
    print(
        f"  {number:>7} peers   {1e9 * taken / ticks:6.2f} ns a peer and tick   C by hand {1e9 * by_hand / ticks:6.2f} ns   ratio {taken / by_hand:5.2f}, target {MOST_OF_C:g} {kept}   "
        f"differs by {error:.1e}, relative   {judge.within('equal peers against C', error, LINEAR)}"
    )


def lossy(judge: Judge, numbers: list[int]) -> None:
    """Peers that hear each other over ways that lose packets, each way by itself."""
    print("\npeers on a complete graph of unreliable links, 5 % lost, up to 4 ms late or early")
    times = []
    for number in numbers:
        seconds = Fraction(1) if number < 1000 else Fraction(1, 5)
        text = replaced(
            AVERAGE,
            ("{count: 3}", f"{{count: {number}, set: {{device.x: 1 mm}}}}"),
            (LINK, f"{LINK[:-1]}, loss: 5 %, jitter: 4 ms}}"),
        )
        ready = prepare(compiled(text), Settings(seconds, seed=SEED), signals=["user[1].*"])
        taken, _ = median_time(partial(_play, ready), 3)
        times.append(taken / float(seconds))
        said = (
            f"target {MOST_LOSSY:g} {judge.in_time('300 lossy peers', times[-1], MOST_LOSSY)}"
            if number == 300
            else ""
        )
        print(f"  {number:>7} peers   {times[-1]:8.3f} of real time   {said}")
    exponent = math.log(times[-1] / times[0]) / math.log(numbers[-1] / numbers[0])
    kept = judge.in_time("lossy peers, exponent", exponent, MOST_EXPONENT, noise=1)
    print(f"  exponent {exponent:.2f}, target {MOST_EXPONENT:g} {kept}")


def runs_by_hand(lost: NDArray[np.bool_], ticks: int) -> tuple[Floats, Floats, Floats]:
    """Play runs of three users side by side in NumPy; `lost` is (frames, runs, senders, receivers).

    Returns
    -------
    The positions (ticks, runs, users, 2), largest forces and last distances of the cubes of each run.
    """
    a, b = user_plant()
    both = expm(np.block([[a, b], [np.zeros((2, 6))]]) * TICK)[:4].T.copy()
    runs = lost.shape[1]
    state = np.zeros((runs, USERS, 6))  # the forces that act are the last two
    state[..., 0] = state[..., 2] = [float(word.split()[0]) * 1e-3 for word in STARTS[1:-1].split(",")]
    held = np.repeat(state[:, :, None, 2], USERS, axis=2)  # (runs, senders, receivers)
    others, sent = 1.0 - np.eye(USERS), held.copy()
    rows, largest = np.empty((ticks, runs, USERS, 2)), np.zeros((runs, USERS, 2))
    force = np.zeros((runs, USERS, 2))
    for k in range(ticks):
        rows[k] = state[..., [0, 2]]
        np.maximum(largest, np.abs(force), out=largest)
        if k % TICKS == 0:
            if k:
                held = np.where(lost[k // TICKS - 1], held, sent)
            sent = np.repeat(state[:, :, None, 2], USERS, axis=2)
            heard = (held * others).sum(axis=1) / (USERS - 1)
        state[..., 4:] = force
        force = np.stack([K_C * (state[..., 0] - state[..., 2]), K_T * (state[..., 2] - heard)], axis=-1)
        state[..., :4] = state @ both
    return rows, largest.max(axis=(1, 2)), np.ptp(rows[-1, :, :, 1], axis=1)


def _draw_and_play(ticks: int) -> Floats:
    """Do all that the program by hand does: its own packets, the runs, when each settles."""
    lost = np.random.default_rng(SEED).random((ticks // TICKS + 1, RUNS, USERS, USERS)) < LOSS
    rows, _, _ = runs_by_hand(lost, ticks)
    span = np.ptp(rows, axis=0).max(axis=1, keepdims=True)
    outside = (np.abs(rows - rows[-1]) > 0.05 * span).any(axis=(2, 3))
    return np.asarray(ticks - outside[::-1].argmax(axis=0), np.float64)


def many_runs(judge: Judge) -> None:
    """Many runs of a second of three users, each with packets of its own."""
    ticks = 1001
    system = compiled(replaced(AVERAGE, APART, (LINK, f"{LINK[:-1]}, loss: 5 %}}")))
    how = Settings(Fraction(1), seed=SEED)
    play_many(system, how, runs=RUNS)  # compiled
    taken, found = median_time(partial(play_many, system, how, runs=RUNS), 5)
    by_hand, _ = median_time(partial(_draw_and_play, ticks), 3)
    law, few = channel_law(system, system.links[0], Fraction(8, 1000)), 20
    pairs = [(i, j) for i in range(USERS) for j in range(USERS)]
    lost = np.array([
        np.isinf(PacketSource(law, "lan", pairs, seed=SEED, run=run).take(ticks // TICKS + 1)) for run in range(few)
    ])  # fmt: skip
    lost = lost.reshape(few, USERS, USERS, -1).transpose(3, 0, 1, 2)
    _, largest, apart = runs_by_hand(lost, ticks)
    ours = [(one.largest_force, one.copies_apart) for one in found.runs[:few]]
    error = float(
        (np.abs(np.array(ours, np.float64).T - [largest, apart]) / [[largest.max()], [apart.max()]]).max()
    )
    ours = taken, f"{error:.1e} apart"
    judge.beside(f"{RUNS:,} runs of a lossy second", ours, "NumPy, all runs at once", (by_hand, "–"))
    kept = judge.in_time("many runs, of the NumPy program", taken / by_hand, MOST_OF_RUNS)
    print(
        f"\n{RUNS} runs of 1 s of three users, 5 % lost: {taken:.3f} s, {1e6 * taken / RUNS:.0f} µs a run   NumPy by hand, all runs at once, {by_hand:.3f} s   "
        f"ratio {taken / by_hand:.2f}, target {MOST_OF_RUNS:g} {kept}   {few} of them differ by {error:.1e}, relative   {judge.within('runs against the NumPy program', error, LINEAR)}"
    )


def populations(numbers: list[int]) -> None:
    """Many equal peers at 1 kHz, one of them recorded."""
    print("\nequal peers, forces every 1 ms, one peer recorded, one core")
    for number in numbers:
        seconds = Fraction(1) if number <= 10**4 else Fraction(1, 10)
        system = compiled(replaced(AVERAGE, ("{count: 3}", f"{{count: {number}, set: {{device.x: 1 mm}}}}")))
        prepared, ready = waited(partial(prepare, system, Settings(seconds), signals=["user[1].*"]))
        taken, _ = median_time(partial(_play, ready), 3)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(
            f"  {number:>7} peers   {taken / float(seconds):8.3f} of real time   prepared in {prepared:5.2f} s   process at most {peak:.2f} GiB so far"
        )


def main() -> None:
    """Print everything."""
    parser = parser_of("simulate", __doc__)
    parser.add_argument("--quick", action="store_true", help="leave out the largest population")
    given = parser.parse_args()
    judge = Judge(given.strict)
    with single_threaded():
        for check in (against_frame_map, against_events, growth, drag, speed):
            check(judge)
        populations([100, 1000, 10**4] if given.quick else [100, 1000, 10**4, 10**5])
        against_c(judge, 10**4 if given.quick else 10**5)
        lossy(judge, [100, 300] if given.quick else [100, 300, 1000])
        many_runs(judge)
    judge.end()


if __name__ == "__main__":
    main()
